"""The primitive behind hand-written transposes: both modes, batching of some arguments, and what it refuses."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.lowering import interpreted, materialize, recomputed
from rewax.lowering.linear_primitive import ByPlatform, linear_call


def _apply(power, residuals, linear):
    (scale,), (a, b) = residuals, linear
    return (scale**power * a + b, a[..., ::-1])


def _transposed(power, residuals, cotangents):
    (scale,), (p, q) = residuals, cotangents
    return (scale**power * p + q[..., ::-1], p)


def apply(scale, a, b):
    return linear_call(_apply, _transposed, 2, (scale,), (a, b))


def plain(scale, a, b):
    return (scale**2 * a + b, a[::-1])


ARGS = tuple(jnp.asarray(np.random.default_rng(0).standard_normal((3, 4)), jnp.float32))


def test_value_forward_and_reverse_equal_the_plain_function(random_like):
    scale, a, b = ARGS
    for mine, other in zip(apply(*ARGS), plain(*ARGS), strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-6)
    tangents = random_like(1, (a, b))
    for f in (jax.jit, lambda f: f):
        got = f(lambda a, b, da, db: jax.jvp(lambda a, b: apply(scale, a, b), (a, b), (da, db)))(a, b, *tangents)
        want = jax.jvp(lambda a, b: plain(scale, a, b), (a, b), tangents)
        jax.tree.map(lambda g, w: np.testing.assert_allclose(g, w, rtol=1e-6), got, want)
    cotangents = random_like(2, apply(*ARGS))
    got = jax.vjp(lambda a, b: apply(scale, a, b), a, b)[1](cotangents)
    want = jax.vjp(lambda a, b: plain(scale, a, b), a, b)[1](cotangents)
    jax.tree.map(lambda g, w: np.testing.assert_allclose(g, w, rtol=1e-6), got, want)


@pytest.mark.parametrize("axes", [(0, 0, 0), (None, 0, None), (0, None, 1), (1, None, None)])
def test_vmap_of_any_arguments(random_like, axes):
    def shape(axis):
        return {None: (4,), 0: (5, 4), 1: (4, 5)}[axis]

    args = random_like(3, tuple(jnp.zeros(shape(axis)) for axis in axes))
    got, want = jax.vmap(apply, axes)(*args), jax.vmap(plain, axes)(*args)
    jax.tree.map(lambda g, w: np.testing.assert_allclose(g, w, rtol=1e-6), got, want)

    def loss(f):
        return lambda a, b: sum(jnp.sum(jnp.sin(o)) for o in jax.vmap(f, axes)(args[0], a, b))

    got, want = (jax.grad(loss(f), (0, 1))(*args[1:]) for f in (apply, plain))
    jax.tree.map(lambda g, w: np.testing.assert_allclose(g, w, rtol=1e-5), got, want)


def test_only_some_linear_arguments_are_differentiated():
    scale, a, b = ARGS
    got = jax.grad(lambda b: jnp.sum(jnp.sin(apply(scale, a, b)[0])))(b)
    np.testing.assert_allclose(got, jnp.cos(plain(scale, a, b)[0]), rtol=1e-6)


def test_derivative_by_a_residual_is_refused_with_the_reason():
    scale, a, b = ARGS
    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.grad(lambda scale: jnp.sum(apply(scale, a, b)[0]))(scale)


def test_a_program_holds_what_is_written_for_its_platform():
    double = ByPlatform(
        cpu=lambda s, r, linear: (jnp.sin(r[0]) * linear[0],), other=lambda s, r, linear: (jnp.cos(r[0]) * linear[0],)
    )

    def function(x, y):
        return linear_call(double, double, None, (x,), (y,))[0]

    x, y = jnp.float32(0.3), jnp.float32(2.0)
    np.testing.assert_allclose(function(x, y), 2.0 * np.sin(0.3), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.grad(function, 1))(x, y), np.sin(0.3), rtol=1e-6)
    for differentiated in (function, jax.grad(function, 1)):
        of = {p: jax.export.export(jax.jit(differentiated), platforms=[p])(x, y).mlir_module() for p in ("cpu", "cuda")}
        assert "sine" in of["cpu"].replace("cosine", "") and "cosine" not in of["cpu"]
        assert "cosine" in of["cuda"] and "sine" not in of["cuda"].replace("cosine", "")


def test_under_shard_map_that_checks_what_varies():
    """With its default, ``check_vma=True``; parameters are the same on all devices, the rest is sharded."""
    devices = jax.devices()[:2]
    mesh = jax.sharding.Mesh(np.array(devices), ("i",))
    spec, x = jax.P("i"), jnp.arange(4.0)

    def energy(p, x):
        return jnp.sum(jnp.sin(p * x) + x**2)

    def sharded(function):
        def total(p, x):
            return jax.lax.psum(function(p, x), "i")

        return jax.jit(
            jax.shard_map(jax.grad(total, (0, 1)), mesh=mesh, in_specs=(jax.P(), spec), out_specs=(jax.P(), spec))
        )

    expected = jax.grad(energy, (0, 1))(jnp.float32(0.7), x)
    for function in (recomputed(energy), interpreted(energy), lambda p, x: energy(p, materialize(x))):
        found = sharded(function)(jnp.float32(0.7), x)
        jax.tree.map(lambda f, e: np.testing.assert_allclose(f, e, rtol=1e-5), found, expected)


def test_it_can_be_debugged_without_jit():
    with jax.disable_jit():
        value, derivative = jax.value_and_grad(lambda a: materialize(a) * jnp.sin(a))(1.0)
    assert value == jnp.sin(1.0)
    assert derivative == pytest.approx(np.sin(1.0) + np.cos(1.0))


def test_a_collective_over_an_axis_of_vmap_is_refused():
    for function in (lambda x: x - jax.lax.pmean(x, "i"), lambda x: x + jax.lax.axis_index("i")):
        with pytest.raises(ValueError, match=r"uses a collective.* over an axis of vmap: use it outside"):
            jax.jit(jax.vmap(interpreted(function), axis_name="i"))(jnp.arange(3.0))


def test_a_failed_assertion_of_the_function_itself_is_passed_on():
    """It is raised where a collective would fail: while JAX lowers the program."""

    def checked(x):
        if lowering:
            raise AssertionError
        return 2.0 * x

    lowering = False
    traced = jax.jit(jax.vmap(interpreted(checked))).trace(jnp.arange(3.0))
    lowering = True
    with pytest.raises(AssertionError):
        traced.lower()


def test_sharding_over_explicit_axes_that_is_lost_is_said():
    mesh = jax.make_mesh((1,), ("x",), axis_types=(jax.sharding.AxisType.Explicit,))
    xs = jax.device_put(jnp.ones((4, 3)), jax.NamedSharding(mesh, jax.P("x")))
    twice = interpreted(lambda a: 2.0 * a)
    with pytest.warns(UserWarning, match=r"call them inside jax.shard_map"):
        out = jax.jit(jax.vmap(twice))(xs)
    np.testing.assert_array_equal(out, 2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = jax.shard_map(jax.vmap(twice), mesh=mesh, in_specs=jax.P("x"), out_specs=jax.P("x"))
        np.testing.assert_array_equal(jax.jit(alone)(xs), 2.0)
