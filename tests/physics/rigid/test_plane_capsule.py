"""Capsules on planes: MuJoCo's contacts with their directions of friction, derivatives, held directions where upright."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics.rigid.plane_capsule import plane_capsule

SIZE = np.array([0.05, 0.2])
MANY = jax.jit(jax.vmap(plane_capsule, in_axes=(None, None, 0, 0, None)))
WORLD = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" pos=".1 -.2 .05" quat=".9 .3 -.2 .1" margin="9"/>
<body><freejoint/><geom type="capsule" size=".05 .2" margin="9"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def floor():
    mj = mujoco.MjModel.from_xml_string(WORLD)
    data = mujoco.MjData(mj)
    mujoco.mj_kinematics(mj, data)
    return mj, data, data.geom_xpos[0].copy(), data.geom_xmat[0].reshape(3, 3)[:, 2].copy()


def leaning(normal, angles) -> np.ndarray:
    """Unit vectors at these angles from the normal [rad], around it at random."""
    rng = np.random.default_rng(0)
    side = np.cross(normal, rng.standard_normal((len(angles), 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.cos(angles)[:, None] * normal + np.sin(angles)[:, None] * side


def test_contacts_are_mujocos(x64, floor):
    """Lying, leaning and almost upright, either end up: distances, points and all of the frame."""
    mj, data, plane, normal = floor
    angles = np.concatenate([[1e-4, 0.02, 0.2, 0.5, 0.6], np.linspace(0.7, np.pi - 1e-3, 15)])
    center, axis = np.random.default_rng(1).uniform(-0.3, 0.3, (len(angles), 3)), leaning(normal, angles)
    found = [np.asarray(a) for a in MANY(plane, normal, center, axis, SIZE)]
    assert (found[0] < 0).any() and (found[0] > 0).any()
    for i, (distance, point, frame) in enumerate(zip(*found, strict=True)):
        data.qpos[:3] = center[i]
        mujoco.mju_quatZ2Vec(data.qpos[3:], axis[i])
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_collision(mj, data)
        theirs = sorted([c.dist, *c.pos, *c.frame] for c in data.contact)
        ours = sorted([d, *p, *frame.ravel()] for d, p in zip(distance, point, strict=True))
        np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_derivatives_are_those_of_finite_differences(x64, floor, derivatives, central_difference, random_like, inner):
    _, _, plane, normal = floor
    args = jax.tree.map(
        jnp.asarray, (plane, normal, np.array([0.1, 0.2, 0.1]), leaning(normal, np.array([0.4]))[0], SIZE)
    )
    move = random_like(0, args)
    _, forward, weights, reverse = derivatives(lambda a: plane_capsule(*a))(args, move, lambda v: random_like(1, v))
    expected = central_difference(jax.jit(lambda a: plane_capsule(*a)), args, move)
    for found, true in zip(forward, expected, strict=True):
        np.testing.assert_allclose(found, true, atol=1e-8)
    assert inner(weights, forward) == pytest.approx(inner(reverse, move), rel=1e-10)


def test_the_directions_of_friction_are_held_where_it_stands(x64):
    """Their derivative by the tilt would be 1 / lean; that of the distances is there: half the length times the sine."""
    up = jnp.array([0.0, 0.0, 1.0])

    def contact(lean):
        axis = jnp.array([jnp.sin(lean), 0.0, jnp.cos(lean)])
        distance, _, frame = plane_capsule(jnp.zeros(3), up, jnp.array([0.0, 0.0, 0.2]), axis, jnp.asarray(SIZE))
        return distance, frame

    slopes = jax.jit(jax.jacrev(contact))
    for lean in (0.0, 1e-9, 1e-3):
        by_distance, by_frame = slopes(lean)
        np.testing.assert_array_equal(by_frame, 0.0)
        np.testing.assert_allclose(by_distance, [-0.2 * np.sin(lean), 0.2 * np.sin(lean)], atol=1e-12)
