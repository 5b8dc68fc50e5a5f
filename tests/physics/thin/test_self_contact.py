"""Self-contact in motion: derivatives, and layers that stay apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from self_contact_bodies import RUN, crossings, folded

from rewax.physics import thin
from rewax.status import Status


def measured(scene, state):
    end = thin.step(scene, state, thin.static_poses(8, dtype=state.x.dtype), store_every=4)
    weights = jnp.cos(jnp.arange(end.x.size)).reshape(end.x.shape)
    return jnp.sum(weights * (end.x + 0.1 * end.v))


def test_reverse_is_forward_is_finite_difference_in_self_contact(x64, agree_along):
    scene, state = folded()
    rng = np.random.default_rng(2)
    zero = jax.tree.map(jnp.zeros_like, (scene, state))
    changed = jax.tree.map(lambda a: a * (1.0 + 0.5 * rng.random()), scene.self_contact).replace(max_speed=0.0)
    noise = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), state)
    directions = {"law": (zero[0].replace(self_contact=changed), zero[1]), "state": (zero[0], noise)}
    agree_along(measured, (scene, state), directions, step=1e-7, exact=1e-9, bar=1e-4, least=1e-7)


@pytest.mark.parametrize("apart", [True, False])
def test_halves_thrown_at_each_other_cross_only_without_self_contact(x64, apart):
    scene, state = folded(size=1e-4, max_speed=0.9)
    mesh = thin.sheet(0.4, 0.2, 8, 4)
    above = jnp.asarray(np.asarray(mesh.vertices)[:, 0] > 0.21)
    start = state.replace(v=jnp.where(above[:, None], jnp.array([0.0, -0.25, 0.0]), jnp.array([0.0, 0.25, 0.0])))
    assert crossings(mesh, np.asarray(start.x)) == 0
    scene = scene if apart else scene.replace(self_contact=None)
    most, poses = 0, thin.static_poses(40, dtype=float)
    for _ in range(12):  # later the fold springs at more than max_speed
        start = RUN(scene, start, poses)
        most = max(most, crossings(mesh, np.asarray(start.x)))
        if apart and most:
            break
    assert (most == 0) == apart
    if apart:
        status = jax.jit(thin.check_status)
        assert status(scene, start) == 0
        slow = scene.replace(self_contact=scene.self_contact.replace(max_speed=0.5))
        assert status(slow, start) == Status.CROSSED


def test_a_step_without_substeps_is_refused(x64):
    scene, state = folded()
    with pytest.raises(ValueError, match=r"^poses has one boundary and so no substep"):
        thin.step(scene, state, thin.static_poses(0, dtype=float))
