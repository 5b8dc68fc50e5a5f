"""Kernels of self-contact in batches and in single precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER
from self_contact_bodies import FORCE, cloth_scene, folded, law

from rewax.physics import thin
from rewax.physics.thin import broad_phase
from rewax.physics.thin.pair_kernels import find_pairs


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


def pairs_of(list_of_pairs):
    first, second, count = list_of_pairs
    return sorted(zip(np.asarray(first[:count]).tolist(), np.asarray(second[:count]).tolist(), strict=True))


@NEEDS_COMPILER
def test_infinite_lengths_find_each_pair_once():
    """Boxes without bounds overlap the empty boxes at the end of a tree."""
    mesh = thin.sheet(0.4, 0.2, 5, 4)
    elements = cloth_scene(mesh, dt=2e-5, self_contact=law(thickness=0.012)).contact_elements
    x, capacity = jnp.asarray(mesh.vertices.T, jnp.float32), 4000
    lengths = jnp.full(3, jnp.inf, jnp.float32)
    for with_triangles in (False, True):
        found = find_pairs(elements, tuple(x), lengths, with_triangles=with_triangles, capacity=capacity)
        whole = broad_phase.find_pairs(elements, x, lengths, with_triangles, capacity)
        assert 0 < found[2] < capacity and pairs_of(found) == pairs_of(whole)


@NEEDS_COMPILER
@pytest.mark.parametrize("same", [(1, 0), (2, 1), (2, 0)])
def test_triangles_without_an_area_keep_their_pairs(same):
    mesh = thin.sheet(0.2, 0.1, 2, 1)
    elements = cloth_scene(mesh, dt=2e-5, self_contact=law(thickness=0.012)).contact_elements
    x = np.asarray(mesh.vertices.T, np.float32)
    corners = np.asarray(mesh.triangles)[0]
    x[:, corners[same[0]]] = x[:, corners[same[1]]]
    lengths = jnp.full(3, 0.3, jnp.float32)
    found = find_pairs(elements, tuple(jnp.asarray(x)), lengths, with_triangles=True, capacity=200)
    whole = broad_phase.find_pairs(elements, jnp.asarray(x), lengths, True, 200)
    assert found[2] > 0 and pairs_of(found) == pairs_of(whole)
