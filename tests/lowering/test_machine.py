"""Interpreted programs: the numbers and derivatives of JAX, for many batch elements side by side."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import build, pointwise
from rewax.lowering import machine as module
from rewax.lowering.machine import interpreted
from rewax.physics.rigid.solver import implicit_correction, solve_spd

INDICES = np.array([2, 0, 2])


@pytest.fixture
def machine_only(monkeypatch):
    """What the machine cannot run fails, instead of being computed with JAX."""

    def refuse(which, *args):
        raise AssertionError(f"there is no bytecode for the {which}")

    monkeypatch.setattr(module, "_with_jax", refuse)


def square(inputs):
    matrix = inputs["matrix"]
    return matrix @ matrix.T + 3.0 * jnp.eye(3, dtype=matrix.dtype)


def moved(solved, inputs, gain):
    """Uses everything that articulated bodies use: tables, indices, selections, angles, empty arrays."""
    a = inputs["a"]
    turned = jnp.sin(a[INDICES]) * gain - jnp.arctan2(a, 2.0 + a[::-1] ** 2)
    steepest = jax.nn.one_hot(jnp.argmax(jnp.abs(a)), 3, dtype=a.dtype) * (inputs["index"] > 1)
    kept = jnp.where(inputs["active"], solved, jnp.clip(turned, -0.4, 0.4)) + steepest
    return {
        "x": kept.at[1].add(jnp.sum(inputs["matrix"])), "y": a[0], "none": a[:0], "one": jnp.ones((), a.dtype)
    }  # fmt: skip


def plain(inputs, gain):
    return moved(jnp.linalg.solve(square(inputs), inputs["a"]), inputs, gain)


def iterated(inputs, gain):
    return moved(solve_spd(square(inputs), inputs["a"]), inputs, gain)


def balance(known, inputs, gain):
    del known
    found = solve_spd(*jax.lax.stop_gradient((square(inputs), inputs["a"])))
    residual = square(inputs) @ found - inputs["a"]
    return moved(found - implicit_correction(square(inputs), residual), inputs, gain)


FAST = interpreted(iterated, derivative_of=balance)


def arguments(*batch, dtype=np.float64):
    draw = np.random.default_rng(len(batch))
    inputs = {
        "a": jnp.asarray(draw.normal(size=(*batch, 3)), dtype),
        "matrix": jnp.asarray(draw.normal(size=(3, 3)), dtype),
        "index": jnp.asarray(draw.integers(0, 4, (*batch, 3)), np.int32),
        "active": jnp.asarray(draw.integers(0, 2, (*batch, 3)), bool),
    }
    return inputs, jnp.asarray(draw.uniform(0.5, 1.5, batch[-1:]), dtype)


def everything(function, inputs, gain, tangents, cotangents):
    """Value, forward and reverse derivative."""
    rest = {name: inputs[name] for name in ("index", "active")}

    def real(a, matrix, gain):
        return function({"a": a, "matrix": matrix, **rest}, gain)

    args = (inputs["a"], inputs["matrix"], gain)
    value, tangent = jax.jvp(real, args, tangents)
    return value, tangent, jax.vjp(real, *args)[1](cotangents)


AXES = [
    ({"a": 0, "matrix": None, "index": 0, "active": 0}, 0),
    ({"a": 0, "matrix": None, "index": 0, "active": 0}, None),
]
"""Of each vmap, innermost first: which arrays have its axis."""


@NEEDS_COMPILER
@pytest.mark.parametrize("batch", [(), (5,), (37,), (3, 7)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_value_forward_and_reverse_are_those_of_jax(machine_only, random_like, relative_error, batch, dtype):
    """One batch element, fewer and more than fit into a vector, and arguments that have not all of the axes."""

    def run(function, *args):
        program = lambda *args: everything(function, *args)  # noqa: E731
        for given, of_gain in AXES[: len(batch)]:
            program = jax.vmap(program, (given, of_gain, (given["a"], None, of_gain), 0))
        return jax.jit(program)(*args)

    with jax.enable_x64(dtype is np.float64):
        inputs, gain = arguments(*batch, dtype=dtype)
        tangents = random_like(0, (inputs["a"], inputs["matrix"], gain))
        shapes = {"x": (*batch, 3), "y": batch, "none": (*batch, 0), "one": batch}
        cotangents = random_like(1, {name: jax.ShapeDtypeStruct(shape, dtype) for name, shape in shapes.items()})
        found, expected = (run(function, inputs, gain, tangents, cotangents) for function in (FAST, plain))
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        assert relative_error(found, expected) < 300 * np.finfo(dtype).eps


def test_what_is_no_arithmetic_is_left_to_jax(x64, monkeypatch, relative_error):
    """Rule by rule: an iteration has no bytecode, but its derivative by the implicit function theorem may have it."""
    left = []
    with_jax = module._with_jax
    monkeypatch.setattr(module, "_with_jax", lambda which, *args: left.append(which) or with_jax(which, *args))

    def root(a):
        one = jnp.sort(jnp.stack([a, -a]))[1]  # what has no bytecode
        return jax.lax.while_loop(lambda x: jnp.abs(x * x - one) > 1e-12, lambda x: 0.5 * (x + one / x), 1.0 + one)

    fast = interpreted(root, derivative_of=lambda known, a: known + (a - jax.lax.stop_gradient(a)) / (2.0 * known))
    value, slope = jax.vmap(jax.value_and_grad(fast))(jnp.array([2.0, 3.0]))
    assert relative_error((value, slope), (np.sqrt([2.0, 3.0]), 0.5 / np.sqrt([2.0, 3.0]))) < 1e-9
    assert set(left) == ({"value"} if build.compiler() and not build.is_off() else set())


@NEEDS_COMPILER
def test_a_compiler_that_fails(monkeypatch):
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(None, "c++ failed (no space)"))
    inputs, gain = arguments(dtype=np.float32)
    with pytest.warns(UserWarning, match="in XLA, slower than in C\\+\\+: c\\+\\+ failed"):
        found = interpreted(iterated)(inputs, gain)
    np.testing.assert_allclose(found["x"], plain(inputs, gain)["x"], rtol=1e-5)


def test_without_a_compiler(monkeypatch):
    monkeypatch.setattr(build, "compiler", lambda: None)
    inputs, gain = arguments(dtype=np.float32)
    found, expected = (f(inputs, gain)["x"] for f in (FAST, plain))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_single_and_double_precision_in_one_process():
    """The same arguments make another program where numbers are of double precision."""
    fast = interpreted(lambda a: (a, jnp.ones(())))
    for double in (False, True, False):
        with jax.enable_x64(double):
            _, one = jax.jit(lambda a: fast(a))(jnp.ones(2, jnp.float32))
            assert one.dtype == (np.float64 if double else np.float32)


@NEEDS_COMPILER
@pytest.mark.parametrize("function", [jnp.sin, jnp.cos])
def test_a_batch_element_does_not_depend_on_those_beside_it(function):
    angles = np.linspace(0.1, 50.0, 2000, dtype=np.float32)
    beside = angles.copy()
    beside[::16] = np.resize([1e5, np.inf, np.nan], 125)
    for call in (jax.vmap(interpreted(lambda a: function(a))), lambda a: pointwise(lambda _, a: function(a))(None, a)):
        unchanged = np.arange(2000) % 16 != 0
        np.testing.assert_array_equal(call(angles)[unchanged], call(beside)[unchanged])
        np.testing.assert_allclose(call(beside)[::16], function(beside[::16]), rtol=1e-6, atol=1e-6)


@NEEDS_COMPILER
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_machine_can_be_built(dtype):
    assert build.load(module.machine(np.dtype(dtype)).source).library is not None
