"""Boxes against boxes: MuJoCo's signed distances, derivatives, a box that rests flat, and what proxies would miss."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rewax.physics import rigid
from rewax.physics.rigid.box_box import box_box
from rewax.physics.rigid.spring_contacts import Penalty

CUBE, LINK = np.array([0.0325, 0.0325, 0.0325]), np.array([0.0098, 0.01375, 0.027])
NUM = 400
LAW = Penalty(stiffness=5e3, damping=20.0, friction_damping=15.0, onset=1e-3, boxes_touch_once=True)
WORLD = """<mujoco><option gravity="0 0 -9.81"/><default><geom type="box" contype="0" conaffinity="0"/></default>
<worldbody><geom name="table" size=".2 .2 .1" pos="0 0 -.1"/><body name="cube" pos="0 0 .04"><freejoint/>
<geom name="cube" size=".0325 .0325 .0325" mass=".5"/></body></worldbody><contact>
<pair geom1="table" geom2="cube" friction=".8 .8 0 0 0"/></contact></mujoco>"""


def matrices(turns):
    return np.stack([turn.as_matrix() for turn in turns])


@pytest.fixture(scope="module")
def boxes():
    """Poses of a cube and a link that mostly overlap, some almost parallel: (centres, rotations, half sizes) of each."""
    rng = np.random.default_rng(0)
    first = [Rotation.random(random_state=i) for i in range(NUM)]
    second = [Rotation.random(random_state=NUM + i) for i in range(NUM)]
    second[::4] = [turn * Rotation.from_rotvec(0.03 * rng.standard_normal(3)) for turn in first[::4]]
    shift = rng.standard_normal((NUM, 3))
    shift *= rng.uniform(0.03, 0.07, (NUM, 1)) / np.linalg.norm(shift, axis=1, keepdims=True)
    center = rng.uniform(-1.0, 1.0, (NUM, 3))
    return (
        (center, matrices(first), np.tile(CUBE, (NUM, 1))),
        (center + shift, matrices(second), np.tile(LINK, (NUM, 1))),
    )


def contacts(boxes):
    return tuple(map(np.asarray, jax.jit(box_box)(*map(jnp.asarray, (*boxes[0], *boxes[1])))))


def mujocos_distances(boxes):
    """Signed distances by MuJoCo: negative the depth."""
    geom = '<body><freejoint/><geom type="box" size="{} {} {}"/></body>'
    mj = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{geom.format(*CUBE)}{geom.format(*LINK)}</worldbody></mujoco>"
    )
    data, found = mujoco.MjData(mj), []
    for i in range(NUM):
        for k, (center, rotation, _) in enumerate(boxes):
            data.qpos[7 * k : 7 * k + 3] = center[i]
            mujoco.mju_mat2Quat(data.qpos[7 * k + 3 : 7 * k + 7], rotation[i].ravel())
        mujoco.mj_kinematics(mj, data)
        found.append(mujoco.mj_geomDistance(mj, data, 0, 1, 1.0, None))
    return np.array(found)


def outside(boxes, k, point):
    """How far points are out of a box, negative inside."""
    center, rotation, half = boxes[k]
    return np.max(np.abs(np.einsum("nji,nj->ni", rotation, point - center)) - half, axis=1)


def test_boxes_overlap_where_mujocos_do_and_as_deep(x64, boxes):
    """No overlap is missed and none is invented; depths are exact but for edges within 10 degrees of each other."""
    distance, point, normal = contacts(boxes)
    expected = mujocos_distances(boxes)
    assert 0.4 < np.mean(expected < 0) < 0.95
    np.testing.assert_array_equal(distance < 0, expected < 0)
    deep = expected < 0
    error = (distance - expected)[deep]
    assert np.mean(np.abs(error) < 1e-9) > 0.95 and np.abs(error).max() < 5e-4
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
    # Contacts that are less than 4 mm deep are in both boxes, to 2 mm for almost all.
    shallow = deep & (expected > -4e-3)
    assert shallow.sum() > 20
    for k in range(2):
        assert np.quantile(outside(boxes, k, point)[shallow], 0.9) < 2e-3


def test_swapped_boxes_have_the_same_contact_with_the_opposite_normal(x64, boxes):
    distance, point, normal = contacts(boxes)
    swapped = contacts(boxes[::-1])
    np.testing.assert_allclose(swapped[0], distance, atol=1e-12)
    np.testing.assert_allclose(swapped[2], -normal, atol=1e-9)
    np.testing.assert_allclose(swapped[1], point, atol=1e-12)


def test_edges_that_cross_touch_though_no_corner_is_inside(x64):
    """Two crossed bars: spheres in their middles, as thick as they are, do not meet, and no corner is in the other."""
    diagonal = Rotation.from_euler("x", np.pi / 4)
    crossed = Rotation.from_euler("z", np.pi / 2) * diagonal
    half = np.array([[0.1, 0.01, 0.01]])
    height = 2 * 0.01 * np.sqrt(2.0) - 1e-3
    first, second = (
        (np.zeros((1, 3)), matrices([diagonal]), half),
        (
            np.array([[0.03, 0.02, height]]),
            matrices([crossed]),
            half,
        ),
    )
    distance, point, normal = contacts((first, second))
    np.testing.assert_allclose(distance, [-1e-3], atol=1e-12)
    np.testing.assert_allclose(normal, [[0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(point, [[0.03, 0.0, height / 2]], atol=3e-3)
    assert height > 2 * 0.01 + 5e-3


def test_derivatives_are_those_of_finite_differences(x64, boxes, derivatives, central_difference, random_like, inner):
    """Where no two axes overlap about equally."""
    inputs = jax.tree.map(jnp.asarray, (*boxes[0], *boxes[1]))
    dx = list(random_like(2, inputs))
    for k in (1, 4):  # rotations stay rotations
        dx[k] = 0.5 * jnp.einsum("nij,njk->nik", inputs[k], dx[k] - jnp.swapaxes(dx[k], 1, 2))

    def run(inputs):
        return box_box(*inputs)

    _, forward, weights, reverse = derivatives(run)(inputs, tuple(dx), lambda v: random_like(3, v))
    expected = central_difference(jax.jit(run), inputs, tuple(dx), 1e-7)
    error = [np.abs(a - b).reshape(NUM, -1).max(axis=1) for a, b in zip(forward, expected, strict=True)]
    assert np.quantile(np.max(error, axis=0), 0.97) < 1e-5
    assert inner(weights, forward) == pytest.approx(inner(reverse, tuple(dx)), rel=1e-9)


@pytest.mark.parametrize("precision", [False, True])
def test_derivatives_are_finite_where_boxes_are_parallel_or_coincide(precision):
    with jax.enable_x64(precision):
        n = 4
        center = jnp.zeros((n, 3)).at[1, 2].set(0.05).at[2].set(jnp.array([0.06, 0.06, 0.0]))
        turn = jnp.tile(jnp.eye(3), (n, 1, 1))
        turn = turn.at[3].set(jnp.asarray(Rotation.from_euler("z", np.pi / 4).as_matrix()))
        half = jnp.full((n, 3), 0.03)
        inputs = (jnp.zeros((n, 3)), jnp.tile(jnp.eye(3), (n, 1, 1)), half, center, turn, half)
        slopes = jax.jit(jax.jacrev(box_box, argnums=range(6)))(*inputs)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
        np.testing.assert_allclose(np.linalg.norm(box_box(*inputs)[2], axis=1), 1.0, rtol=1e-6)


@pytest.mark.slow
def test_a_box_lies_flat_on_its_one_contact(x64):
    """m g / stiffness deep; tilted to either side it is turned back. MJX's four points carry it a quarter as deep."""
    for law, share in ((LAW, 1.0), (LAW.replace(boxes_touch_once=False), 0.25)):
        model = rigid.load(WORLD, dt=1e-3, penalty=law)
        depth = share * 0.5 * 9.81 / 5e3

        def after(tilt, num_substeps, model=model, depth=depth):
            turn = Rotation.from_euler("x", tilt).as_quat()[[3, 0, 1, 2]]
            state = rigid.initial_state(model, np.concatenate([[0, 0, 0.0325 - depth], turn]))
            return rigid.step(model, state, num_substeps=num_substeps)

        rest = after(0.0, 200)
        np.testing.assert_allclose([*rest.qpos[:3], *rest.qpos[4:]], [0, 0, 0.0325 - depth, 0, 0, 0], atol=1e-7)
        back = [float(after(tilt, 1).qvel[3]) for tilt in (-0.02, 0.02)]
        assert back[0] > 1e-3 and back[1] < -1e-3
