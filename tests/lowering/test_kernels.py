"""Arithmetic element by element: the numbers and derivatives of JAX, from the machine."""

import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import build, report
from rewax.lowering import kernels as module
from rewax.lowering.from_jaxpr import UnsupportedError, from_jaxpr
from rewax.lowering.kernels import pointwise


@pytest.fixture
def machine_only(monkeypatch):
    """What the machine cannot run fails, instead of being computed with JAX."""

    def refuse(which, *args):
        raise AssertionError(f"there is no bytecode for the {which}")

    monkeypatch.setattr(module, "_with_jax", refuse)


def bend(shared, elements):
    """Uses everything that laws and contact use: small arrays, booleans, integers, selections, products."""
    scale, matrix, exponent = shared["scale"], shared["matrix"], shared["exponent"]
    a, b, side, rows = elements
    turned = matrix @ jnp.stack([a, b])
    length = jnp.sqrt(turned[0] ** 2 + turned[1] ** exponent + 1.0)
    picked = jnp.where(side > 1, jnp.log(length), jnp.exp(-length)) * scale
    inside = (a > 0.9) & ~(b < 1.0)
    return {"x": jnp.where(inside, picked, a / b), "rows": rows[::-1] * jnp.maximum(a, b) + jnp.sum(rows, axis=0)}


FAST = pointwise(bend)


def arguments(num: int, *batch: int, dtype=np.float64):
    draw = np.random.default_rng(num)
    a, b = (jnp.asarray(draw.uniform(0.5, 1.5, (*batch, num)), dtype) for _ in range(2))
    rows = jnp.asarray(draw.normal(size=(*batch, 3, num)), dtype)
    side = jnp.asarray(draw.integers(0, 4, (*batch, num)), np.int32)
    shared = {"scale": jnp.asarray(0.7, dtype), "matrix": jnp.asarray(draw.normal(size=(2, 2)), dtype), "exponent": 2}
    return shared, (a, b, side, rows)


def of_real(function, shared, elements):
    """The function of those arguments that can have a derivative, and these."""
    a, b, side, rows = elements
    exponent = shared["exponent"]

    def real(scale, matrix, a, b, rows):
        return function({"scale": scale, "matrix": matrix, "exponent": exponent}, (a, b, side, rows))

    return real, (shared["scale"], shared["matrix"], a, b, rows)


def everything(function, shared, elements, tangents, cotangents):
    real, args = of_real(function, shared, elements)

    @jax.jit
    def all_three(args, tangents, cotangents):
        value, tangent = jax.jvp(real, args, tangents)
        return value, tangent, jax.vjp(real, *args)[1](cotangents)

    return all_three(args, tangents, cotangents)


@NEEDS_COMPILER
@pytest.mark.parametrize("num", [1, 13, 2 * 1024 + 37])
def test_value_forward_and_reverse_are_those_of_jax(x64, machine_only, random_like, relative_error, num):
    """Fewer elements than a vector has, and more than a thread computes at a time."""
    shared, elements = arguments(num)
    real, args = of_real(bend, shared, elements)
    tangents, cotangents = random_like(0, args), random_like(1, jax.eval_shape(real, *args))
    found, expected = (everything(f, shared, elements, tangents, cotangents) for f in (FAST, bend))
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    assert relative_error(found, expected) < 1e-13


@NEEDS_COMPILER
def test_reverse_forward_and_finite_differences(x64, machine_only, random_like):
    shared, elements = arguments(5)
    real, args = of_real(FAST, shared, elements)
    tangents, cotangents = random_like(2, args), random_like(3, jax.eval_shape(real, *args))

    def dot(a, b):
        return sum(jnp.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))

    forward = dot(cotangents, jax.jvp(real, args, tangents)[1])
    reverse = dot(jax.vjp(real, *args)[1](cotangents), tangents)
    h = 1e-6
    ends = [jax.tree.map(lambda a, t, s=s: a + s * h * t, args, tangents) for s in (1, -1)]
    difference = (dot(cotangents, real(*ends[0])) - dot(cotangents, real(*ends[1]))) / (2 * h)
    np.testing.assert_allclose([reverse, difference], forward, rtol=1e-8)


@NEEDS_COMPILER
def test_under_vmap(x64, machine_only, random_like, relative_error):
    """Two axes; elements have both, one or none of them, and so has what is shared."""
    shared, (a, b, side, rows) = arguments(11)
    shared["matrix"] = jnp.stack([shared["matrix"], -shared["matrix"]])
    shared["scale"] = jnp.stack([shared["scale"], 2 * shared["scale"], 3 * shared["scale"]])
    b = jnp.stack([b, b + 0.1, b + 0.2])
    rows = jnp.stack([jnp.stack([rows, -rows])] * 3)

    def batched(function):
        def gradient(scale, matrix, a, b, rows):
            def value(scale, matrix, a, b, rows):
                out = function({"scale": scale, "matrix": matrix, "exponent": 2}, (a, b, side, rows))
                return sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(out))

            return jax.value_and_grad(value, argnums=(0, 1, 2, 3, 4))(scale, matrix, a, b, rows)

        inner = jax.vmap(gradient, in_axes=(None, 0, None, None, 0))
        return jax.jit(jax.vmap(inner, in_axes=(0, None, None, 0, 0)))

    args = (shared["scale"], shared["matrix"], a, b, rows)
    assert relative_error(batched(FAST)(*args), batched(bend)(*args)) < 1e-13


@NEEDS_COMPILER
def test_environments_are_their_own(x64, machine_only):
    """One alone has the bits that it has beside others, of which one is not finite."""
    shared, elements = arguments(1024 + 5, 3, dtype=np.float32)
    elements = jax.tree.map(lambda a: a.at[1].set(jnp.nan) if a.dtype == np.float32 else a, elements)

    def gradient(matrix, elements):
        def bent(matrix, a):
            return FAST({**shared, "matrix": matrix}, (a, *elements[1:]))

        out, pull = jax.vjp(bent, matrix, elements[0])
        return out, pull(jax.tree.map(jnp.ones_like, out))

    together = jax.vmap(gradient, in_axes=(None, 0))(shared["matrix"], elements)
    for i in (0, 2):
        alone = gradient(shared["matrix"], jax.tree.map(lambda a, i=i: a[i], elements))
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            assert np.isfinite(b).all()
            np.testing.assert_array_equal(a[i], b)


@pytest.mark.parametrize("native", ["0", "1"])
def test_a_number_has_the_precision_of_the_elements_with_and_without_cpp(native, monkeypatch):
    """``1 - 2 nu`` of an almost incompressible material is another number in double precision."""
    monkeypatch.setenv("REWAX_NATIVE", native)
    found = pointwise(lambda nu, elements: elements / (1.0 - 2.0 * nu))(0.4999999, jnp.ones(3))
    assert float(found[0]) == 1.0 / (1.0 - 2.0 * np.float32(0.4999999))


@NEEDS_COMPILER
def test_a_number_does_not_make_another_program(machine_only):
    @pointwise
    def scaled(shared, elements):
        return elements * shared

    before = module.target_of.cache_info().misses
    found = [scaled(factor, jnp.arange(3.0))[2] for factor in (2.0, 3.0, jnp.asarray(4.0))]
    np.testing.assert_array_equal(found, [4.0, 6.0, 8.0])
    assert module.target_of.cache_info().misses - before == 1


@pytest.mark.parametrize(
    ("operation", "named"),
    [(jnp.sort, "sort"), (lambda a: jax.lax.while_loop(lambda c: c[0] < 5, lambda c: c + 1, a), "while"),
     (jax.scipy.special.gammaln, "lgamma")],
)  # fmt: skip
def test_what_has_no_bytecode_is_computed_with_jax(operation, named):
    with pytest.raises(UnsupportedError, match=named):
        from_jaxpr(jax.make_jaxpr(operation)(jnp.ones(1)), [True])

    def function(shared, elements):
        return operation(elements) * shared

    a = jnp.asarray([1.5])
    np.testing.assert_array_equal(pointwise(function)(2.0, a), function(2.0, a))
    expected = jax.grad(lambda a: function(2.0, a)[0])(a) if named not in ("while",) else None
    if expected is not None:
        np.testing.assert_allclose(jax.grad(lambda a: pointwise(function)(2.0, a)[0])(a), expected, rtol=1e-6)


def test_without_a_compiler_it_is_the_function(monkeypatch):
    monkeypatch.setenv("REWAX_NATIVE", "0")
    shared, elements = arguments(4, dtype=np.float32)
    plain, same = (str(jax.make_jaxpr(f)(shared, elements)) for f in (bend, FAST))
    assert plain == same and "linear_call" not in same


@pytest.mark.parametrize("native", ["0", "1"])
def test_a_result_of_the_shared_numbers_alone_is_that_of_every_element(native, monkeypatch):
    monkeypatch.setenv("REWAX_NATIVE", native)
    shared, elements = jnp.ones(1), jnp.ones(7)
    twice = pointwise(lambda shared, elements: (2.0 * shared, elements))
    assert twice(shared, elements)[0].shape == (7,)
    assert float(jax.grad(lambda shared: twice(shared, elements)[0].sum())(shared)[0]) == 14.0


@pytest.mark.parametrize(
    "elements",
    [(jnp.ones(4), 2.0), (jnp.ones(4), jnp.ones(1)), (jnp.ones(4), jnp.float32(2.0)), (jnp.ones(0), jnp.ones(0)),
     (jnp.arange(4), jnp.arange(4)), (jnp.ones(4), jnp.ones(4, jnp.bfloat16))],
)  # fmt: skip
def test_elements_that_do_not_fit_together_are_left_to_the_function(elements):
    def product(shared, elements):
        return elements[0] * elements[1] * shared

    fits = np.shape(elements[1]) == (0,)
    with report.recorded() as decisions:
        found, expected = pointwise(product)(3.0, elements), product(3.0, elements)
    assert not build.is_available() or [d.reason is None for d in decisions] == [fits]
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


@NEEDS_COMPILER
def test_single_and_double_precision_in_one_process():
    """What Python's numbers become depends on a switch that no argument shows."""

    @pointwise
    def scaled(shared, elements):
        return elements * jnp.asarray(2.0, float)

    for double in (False, True, False):
        with jax.enable_x64(double):
            found = scaled((), jnp.ones(3, jnp.float32))
            assert found.dtype == (np.float64 if double else np.float32)
            np.testing.assert_array_equal(found, 2.0)


@NEEDS_COMPILER
def test_a_machine_that_cannot_be_built_is_done_without(monkeypatch):
    def cubed(shared, elements):
        return elements**3 + shared

    monkeypatch.setattr(build, "load", lambda source: build.Loaded(None, "c++ failed"))
    with pytest.warns(UserWarning, match="runs in XLA, slower than in C\\+\\+: c\\+\\+ failed"):
        found = pointwise(cubed)(1.0, jnp.arange(3.0))
    np.testing.assert_array_equal(found, [1.0, 2.0, 9.0])


@NEEDS_COMPILER
def test_a_machine_that_refuses_a_program_is_done_without(monkeypatch):
    def refuse(*args):
        raise RuntimeError("no memory")

    monkeypatch.setattr(module, "load", refuse)
    with pytest.warns(UserWarning, match=r"it could not be lowered \(RuntimeError: no memory\)"):
        found = pointwise(lambda shared, elements: elements**5 + shared)(1.0, jnp.arange(3.0))
    np.testing.assert_array_equal(found, [1.0, 2.0, 33.0])


def test_a_program_for_a_gpu_builds_nothing(monkeypatch):
    monkeypatch.setattr(module, "target_of", lambda *args: pytest.fail("bytecode was asked for"))
    monkeypatch.setattr(build, "compiler", lambda: "c++")
    shared, elements = arguments(6, dtype=np.float32)
    jax.jit(pointwise(bend)).trace(shared | {"exponent": 2.0}, elements).lower(lowering_platforms=("cuda",))


def test_laws_are_not_kept_for_ever():
    """A law holds everything that it encloses, and a program may define laws anew at every call."""

    def define():
        def law(shared, elements):
            return elements

        module.broadcast(law)
        return weakref.ref(law)

    first = define()
    for _ in range(2000):
        define()
    gc.collect()
    assert first() is None
