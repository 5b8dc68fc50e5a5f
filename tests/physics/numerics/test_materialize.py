"""The fusion boundary is the identity, for every value, in both modes and under vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics.materialize import materialize


def tree(first):
    return {"a": jnp.array([first, 1.5, -2.0, jnp.nan]), "b": (jnp.arange(6.0).reshape(2, 3), jnp.float32(7.0))}


@pytest.mark.parametrize("first", [0.0, np.nan, np.inf, -np.inf, -3e38])
def test_identity_bit_for_bit(first):
    """Also where the number that the loop's condition looks at is not finite."""
    t = tree(first)
    for f in (materialize, jax.jit(materialize)):
        jax.tree.map(np.testing.assert_array_equal, f(t), t)


def test_derivative_is_the_identity(random_like):
    t = tree(2.0)
    tangent, cotangent = random_like(0, t), random_like(1, t)
    jax.tree.map(np.testing.assert_array_equal, jax.jvp(materialize, (t,), (tangent,))[1], tangent)
    (back,) = jax.jit(lambda ct: jax.vjp(materialize, t)[1](ct))(cotangent)
    jax.tree.map(np.testing.assert_array_equal, back, cotangent)


def test_vmap_of_one_leaf_of_two():
    a, b = jnp.arange(12.0).reshape(3, 4), jnp.arange(4.0)
    got_a, got_b = jax.vmap(lambda a: materialize((a, b)))(a)
    np.testing.assert_array_equal(got_a, a)
    np.testing.assert_array_equal(got_b, np.broadcast_to(b, (3, 4)))
    gradient = jax.grad(lambda b: jnp.sum(jax.vmap(lambda a: jnp.prod(jnp.stack(materialize((a, b)))))(a)))(b + 1.0)
    expected = jax.grad(lambda b: jnp.sum(jax.vmap(lambda a: jnp.prod(jnp.stack((a, b))))(a)))(b + 1.0)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)
