"""The fusion boundary is the identity, for every value, in both modes and under vmap; what it is for happens."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics.materialize import compute_once, materialize

BOTH = pytest.mark.parametrize("boundary", [materialize, compute_once])


def tree(first):
    return {"a": jnp.array([first, 1.5, -2.0, jnp.nan]), "b": (jnp.arange(6.0).reshape(2, 3), jnp.float32(7.0))}


@BOTH
@pytest.mark.parametrize("first", [0.0, np.nan, np.inf, -np.inf, -3e38])
def test_identity_bit_for_bit(boundary, first):
    """Also where the number that the loop's condition looks at is not finite."""
    t = tree(first)
    for f in (boundary, jax.jit(boundary)):
        jax.tree.map(np.testing.assert_array_equal, f(t), t)


@BOTH
def test_derivative_is_the_identity(boundary, random_like):
    t = tree(2.0)
    tangent, cotangent = random_like(0, t), random_like(1, t)
    jax.tree.map(np.testing.assert_array_equal, jax.jvp(boundary, (t,), (tangent,))[1], tangent)
    (back,) = jax.jit(lambda ct: jax.vjp(boundary, t)[1](ct))(cotangent)
    jax.tree.map(np.testing.assert_array_equal, back, cotangent)


@BOTH
def test_vmap_of_one_leaf_of_two(boundary):
    a, b = jnp.arange(12.0).reshape(3, 4), jnp.arange(4.0)
    got_a, got_b = jax.vmap(lambda a: boundary((a, b)))(a)
    np.testing.assert_array_equal(got_a, a)
    np.testing.assert_array_equal(got_b, np.broadcast_to(b, (3, 4)))
    gradient = jax.grad(lambda b: jnp.sum(jax.vmap(lambda a: jnp.prod(jnp.stack(boundary((a, b)))))(a)))(b + 1.0)
    expected = jax.grad(lambda b: jnp.sum(jax.vmap(lambda a: jnp.prod(jnp.stack((a, b))))(a)))(b + 1.0)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)


@BOTH
def test_a_chain_is_computed_once_and_not_in_each_of_its_users(boundary):
    """XLA copies a sine into each of four reductions. Behind a boundary there is one, and the loop's condition has one."""
    x = jnp.linspace(0.0, 1.0, 4096).reshape(64, 64)

    def sines(store) -> int:
        def reductions(x):
            y = store(jnp.sin(x))
            return jnp.sum(y, axis=0), jnp.sum(y * y, axis=1), jnp.max(y[::-1] - y, axis=0), jnp.min(y * x, axis=1)

        return jax.jit(reductions).lower(x).compile().as_text().count(" sine(")

    assert sines(boundary) <= 2 and sines(lambda a: a) >= 4


def test_users_that_compare_see_one_rounding():
    """A number is never above the largest of a group to which it belongs. Rounded twice, in two ways, it can be."""
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.normal(size=64_000), jnp.float32) for _ in range(2))
    group = jnp.arange(64_000) % 1000

    @jax.jit
    def above_the_largest(a, b):
        y = compute_once(a * b + a * a)
        largest = jnp.full(1000, -jnp.inf, jnp.float32).at[group].max(y)
        return jnp.sum(y > largest[group])

    assert above_the_largest(a, b) == 0
