"""Forces that tools and ground feel from tetrahedra: balance of momentum, patches, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
from tet_bodies import body, shaken

from rewax.physics import tets
from rewax.physics.contact import WALLS, Collider, Patches
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box

NUM = 20


def pushed():
    """A block on the ground that a plate pushes along x, and the plate's poses."""
    plate = Collider(shape=Box(half_size=(0.1, 0.5, 0.5)), friction=0.5)
    law = PenaltyContact(stiffness=2e3, damping=5.0, friction_damping=2.0, friction=0.4)
    scene, state = body(
        gravity=(0.0, -10.0, 0.0), contact=law, ground=Ground(normal=(0.0, 1.0, 0.0), height=-0.09), colliders=(plate,)
    )
    left = float(state.x[:, 0].min())
    at = jnp.array([left - 0.08, 0.0, 0.0]) + jnp.linspace(0.0, 0.02, NUM + 1)[:, None] * jnp.array([1.0, 0.0, 0.0])
    return scene, state, Pose(at[:, None], jnp.broadcast_to(jnp.eye(3), (NUM + 1, 1, 3, 3)))


def test_forces_are_gravity_minus_the_rate_of_change_of_momentum(x64):
    scene, state, poses = pushed()
    patches = {"both": Patches(body=(0, WALLS)), "halves": Patches(body=(0, 0), center=[[0, 0, 0.05], [0, 0, -0.05]])}
    end, felt = jax.jit(tets.step_with_touch)(scene, state, poses, patches)
    jax.tree.map(np.testing.assert_array_equal, end, jax.jit(tets.step)(scene, state, poses))
    change = np.asarray(scene.mass) @ np.asarray(end.v - state.v) / (NUM * float(scene.dt))
    expected = float(scene.mass.sum()) * np.array([0.0, -10.0, 0.0]) - change
    np.testing.assert_allclose(felt["both"].force.sum(0), expected, rtol=1e-10, atol=1e-9)
    assert felt["both"].force[0, 0] < -1.0 and felt["both"].force[1, 1] < -1.0
    for part, whole in zip(felt["halves"], felt["both"], strict=True):
        np.testing.assert_allclose(part.sum(0), whole[0], rtol=1e-10, atol=1e-10)


def test_the_derivative_of_forces_is_exact(x64, random_like, derivatives_agree):
    scene, state, poses = pushed()
    state = shaken(state, 1e-3, 0.1)

    def felt(given):
        state, shift = given
        return tets.step_with_touch(scene, state, poses._replace(position=poses.position + shift), Patches(body=(0, WALLS)))[1]  # fmt: skip

    at = (state, jnp.zeros(3))
    dx = jax.tree.map(lambda a: 1e-3 * a, random_like(0, at))
    value, _ = derivatives_agree(felt, at, dx, step=1e-4, bar=1e-6, exact=1e-9)
    assert np.abs(value.force).max() > 1.0
