"""All components of all particles in one array."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.mpm import MPMState
from rewax.physics.mpm.packing import join, pack, split, unpack


@pytest.mark.parametrize("remembers", [0, 1, 3])
def test_split_and_join(remembers):
    draw = np.random.default_rng(0)
    x, v, C, F = (jnp.asarray(draw.normal(size=(5, *shape))) for shape in ((3,), (3,), (3, 3), (3, 3)))
    state = MPMState(x=x, v=v, C=C, F=F, memory=jnp.asarray(draw.normal(size=(5, remembers))) if remembers else None)
    packed = split(state)
    assert packed.shape == (24 + remembers, 5)
    jax.tree.map(np.testing.assert_array_equal, join(packed), state)
    particles = unpack(packed)
    for i in range(3):
        np.testing.assert_array_equal(particles.x[i], x[:, i])
        np.testing.assert_array_equal(particles.v[i], v[:, i])
        for j in range(3):
            np.testing.assert_array_equal(particles.C[i][j], C[:, i, j])
            np.testing.assert_array_equal(particles.F[i][j], F[:, i, j])
    assert len(particles.memory) == remembers
    np.testing.assert_array_equal(pack(particles), packed)


def test_the_transpose_is_a_stack():
    cotangents = [jnp.full(2, float(k)) for k in range(24)]
    (back,) = jax.vjp(lambda a: jax.tree.leaves(unpack(a)), jnp.zeros((24, 2)))[1](cotangents)
    np.testing.assert_array_equal(back, np.stack(cotangents))
