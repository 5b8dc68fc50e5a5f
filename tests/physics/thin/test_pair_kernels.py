"""Kernels of self-contact in batches and in single precision."""

import jax
import jax.numpy as jnp
import numpy as np
from self_contact_bodies import FORCE, folded

from rewax.physics import thin


def test_a_batch_is_a_loop_and_float32_is_near(x64):
    scene, _ = folded()
    states = [folded(seed)[1] for seed in (0, 1)]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *states)
    batch = jax.jit(jax.vmap(thin.self_contact_force, in_axes=(None, 0)))(scene, stacked)
    for each, state in zip(batch, states, strict=True):
        np.testing.assert_allclose(each, FORCE(scene, state), atol=1e-13)
    narrow = jax.tree.map(lambda a: a.astype(jnp.float32), (scene, states[0]))
    small = FORCE(*narrow)
    assert small.dtype == jnp.float32
    np.testing.assert_allclose(small, batch[0], atol=1e-4)
