"""Clipping is that of NumPy, and its derivative at a bound is that of the inside."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.clipping import clipped

VALUES = jnp.array([-2.0, -1.0, 0.5, 1.0, 3.0])


def test_it_clips_and_keeps_nan():
    np.testing.assert_array_equal(clipped(VALUES, -1.0, 1.0), np.clip(VALUES, -1.0, 1.0))
    assert np.isnan(clipped(jnp.float32(jnp.nan), -1.0, 1.0))


def test_at_a_bound_the_derivative_is_that_of_the_inside():
    by_value, by_low, by_high = jax.vmap(jax.grad(clipped, argnums=(0, 1, 2)), in_axes=(0, None, None))(
        VALUES, -1.0, 1.0
    )
    np.testing.assert_array_equal(by_value, [0.0, 1.0, 1.0, 1.0, 0.0])
    np.testing.assert_array_equal(by_low, [1.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(by_high, [0.0, 0.0, 0.0, 0.0, 1.0])
