"""Shuffled parts of a rollout hold every sample once."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.agents.minibatches import shuffled


def test_every_sample_is_in_one_part_and_keeps_its_fields_together():
    batch = {"a": jnp.arange(12.0).reshape(3, 4), "b": 2.0 * jnp.arange(12.0).reshape(3, 4)[..., None]}
    parts = shuffled(jax.random.key(0), batch, 4)
    assert parts["a"].shape == (4, 3) and parts["b"].shape == (4, 3, 1)
    np.testing.assert_array_equal(np.sort(parts["a"].ravel()), np.arange(12.0))
    np.testing.assert_array_equal(parts["b"][..., 0], 2.0 * parts["a"])
    assert not np.array_equal(parts["a"].ravel(), np.arange(12.0))
