"""Boxes on planes: MuJoCo's contacts, corners by hand, derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics.rigid.plane_box import plane_box

HALF = np.array([0.3, 0.2, 0.1])
WORLD = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" pos=".1 -.2 .05" quat=".9 .3 -.2 .1" margin="9"/>
<body name="box"><freejoint/><geom name="box" type="box" size="0.3 0.2 0.1" margin="9"/></body></worldbody></mujoco>"""
MANY = jax.jit(jax.vmap(plane_box, in_axes=(None, None, 0, 0, None)))


@pytest.fixture(scope="module")
def floor():
    """A point of the floor and the normal of it, and MuJoCo's data, its kinematics known."""
    model = mujoco.MjModel.from_xml_string(WORLD)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    number = model.geom("floor").id
    return model, data, data.geom_xpos[number].copy(), data.geom_xmat[number].reshape(3, 3)[:, 2].copy()


def in_order(distance, point):
    """Contacts sorted by distance; MuJoCo and we list corners in orders of our own."""
    table = np.column_stack([distance, point])
    return table[np.argsort(table[:, 0])]


def test_contacts_are_mujocos(x64, rotations, floor):
    """Above, across and below the plane, turned at random: the four lower corners and the points halfway to the plane."""
    model, data, plane, normal = floor
    center, rotation = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3)), rotations(1, 50)
    distance, point = (np.asarray(a) for a in MANY(plane, normal, center, rotation, HALF))
    assert (distance < 0).any() and (distance > 0).any()
    quaternion = np.zeros(4)
    for i in range(50):
        mujoco.mju_mat2Quat(quaternion, rotation[i].ravel())
        data.qpos[:] = [*center[i], *quaternion]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        theirs = in_order([c.dist for c in data.contact], [c.pos for c in data.contact])
        np.testing.assert_allclose(in_order(distance[i], point[i]), theirs, atol=1e-9)


def test_a_box_that_stands_touches_with_its_four_lower_corners(x64):
    """1 cm deep: points half a centimetre above the corners, on the corners' verticals."""
    distance, point = plane_box(jnp.zeros(3), jnp.array([0.0, 0, 1]), jnp.array([1.0, 2.0, 0.09]), jnp.eye(3), HALF)
    np.testing.assert_allclose(distance, -0.01, atol=1e-6)
    corners = {(round(float(x), 4), round(float(y), 4)) for x, y, _ in point}
    assert corners == {(0.7, 1.8), (0.7, 2.2), (1.3, 1.8), (1.3, 2.2)}
    np.testing.assert_allclose(point[:, 2], -0.005, atol=1e-6)


def test_a_tilted_box_keeps_corners_that_are_millimetres_shallower(x64):
    """Tilted by 0.05 about y: the corners along x differ by 2 * 0.3 sin 0.05, which is 3 cm; all four are there."""
    c, s = np.cos(0.05), np.sin(0.05)
    turn = jnp.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    distance, _ = plane_box(jnp.zeros(3), jnp.array([0.0, 0, 1]), jnp.array([0.0, 0, 0.05]), turn, HALF)
    low, high = 0.05 - 0.1 * c - 0.3 * s, 0.05 - 0.1 * c + 0.3 * s
    np.testing.assert_allclose(np.sort(distance), [low, low, high, high], atol=1e-6)


def test_derivatives_are_those_of_finite_differences(
    x64, rotations, floor, derivatives, central_difference, random_like, inner
):
    """By plane, normal, centre, rotation and size; the distance's derivative by the centre is the normal."""
    _, _, plane, normal = floor
    args = jax.tree.map(jnp.asarray, (plane, normal, np.array([0.1, 0.2, 0.15]), rotations(3, 1)[0], HALF))
    move = random_like(0, args)
    _, forward, weights, reverse = derivatives(lambda a: plane_box(*a))(args, move, lambda v: random_like(1, v))
    expected = central_difference(jax.jit(lambda a: plane_box(*a)), args, move)
    for found, true in zip(forward, expected, strict=True):
        np.testing.assert_allclose(found, true, atol=1e-8)
    assert inner(weights, forward) == pytest.approx(inner(reverse, move), rel=1e-10)
    by_center = jax.jacobian(lambda c: plane_box(*args[:2], c, *args[3:])[0])(args[2])
    np.testing.assert_allclose(by_center, np.tile(normal, (4, 1)), atol=1e-12)


def test_derivatives_are_finite_where_corners_are_equally_high(x64):
    flat = jnp.zeros(3), jnp.array([0.0, 0, 1]), jnp.array([0.0, 0, 0.1]), jnp.eye(3), jnp.asarray(HALF)
    slopes = jax.jit(jax.jacrev(plane_box, argnums=range(5)))(*flat)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
