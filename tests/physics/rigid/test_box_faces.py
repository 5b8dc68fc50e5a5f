"""Boxes on boxes: MuJoCo's contacts of faces and of edges, by hand, derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics.rigid.box_faces import MOST, box_faces
from rewax.xla_options import unoptimised

SIZES = np.array([[0.05, 0.06, 0.07], [0.1, 0.03, 0.08]])
NUM = 300
QUICK = unoptimised()
MANY = jax.jit(jax.vmap(box_faces, in_axes=(0, 0, None, 0, 0, None)), compiler_options=QUICK)
UP = np.array([0.0, 0.0, 1.0])


def one(*boxes):
    """Contacts of one pair, by the program that serves many."""
    alike = [np.tile(a, (NUM,) + (1,) * np.ndim(a)) if k % 3 < 2 else a for k, a in enumerate(map(np.asarray, boxes))]
    return (np.asarray(a)[0] for a in MANY(*alike))


@pytest.fixture(scope="module")
def boxes():
    """Positions and quaternions of pairs that overlap or nearly do; a third of them almost aligned."""
    rng = np.random.default_rng(1)
    turn = rng.standard_normal((2, NUM, 4))
    turn[:, : NUM // 3] = [1.0, 0, 0, 0] + 0.03 * rng.standard_normal((2, NUM // 3, 4))
    turn /= np.linalg.norm(turn, axis=2, keepdims=True)
    place = np.zeros((2, NUM, 3))
    way = rng.standard_normal((NUM, 3))
    place[1] = way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0.06, 0.15, (NUM, 1))
    rotation = np.zeros((2, NUM, 9))
    for box, pair in np.ndindex(2, NUM):
        mujoco.mju_quat2Mat(rotation[box, pair], turn[box, pair])
    return place, turn, rotation.reshape(2, NUM, 3, 3)


def in_order(table) -> np.ndarray:
    table = np.asarray(table, float).reshape(-1, 7)
    return table[np.lexsort(np.round(table, 7).T)]


def test_contacts_are_mujocos(x64, boxes):
    """Their number, distances, points and normals, of faces with up to seven contacts and of edges with one."""
    place, turn, rotation = boxes
    found = [np.asarray(a) for a in MANY(place[0], rotation[0], SIZES[0], place[1], rotation[1], SIZES[1])]
    body = '<body><freejoint/><geom type="box" size="{} {} {}"/></body>'
    mj = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody>" + "".join(body.format(*size) for size in SIZES) + "</worldbody></mujoco>"
    )
    data, counts, edges = mujoco.MjData(mj), set(), 0
    for pair, (distance, point, normal) in enumerate(zip(*found, strict=True)):
        data.qpos[:] = np.concatenate([place[0, pair], turn[0, pair], place[1, pair], turn[1, pair]])
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_collision(mj, data)
        theirs = in_order([[c.dist, *c.pos, *c.frame[:3]] for c in data.contact])
        ours = in_order(np.column_stack([distance, point, np.tile(normal, (MOST, 1))])[distance < 0])
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
        axes = np.abs(np.einsum("bij,i->bj", rotation[:, pair], normal))
        edges += len(ours) > 0 and axes.max() < 1 - 1e-9
        counts.add(len(ours))
    assert counts >= {0, 1, 2, 3, 4, 5} and edges > NUM // 10


def test_a_box_that_lies_on_another_touches_at_its_corners(x64):
    """1 cm deep and beyond the rim at one side: two corners of its own, two where the outlines cross."""
    below, above, center = np.array([0.5, 0.5, 0.1]), np.array([0.2, 0.2, 0.1]), np.array([0.4, 0.1, 0.19])
    distance, point, normal = one(np.zeros(3), np.eye(3), below, center, np.eye(3), above)
    assert np.sum(distance < 0) == 4
    np.testing.assert_allclose(distance[:4], -0.01, atol=1e-12)
    np.testing.assert_allclose(normal, UP, atol=1e-12)
    corners = sorted((round(float(x), 6), round(float(y), 6)) for x, y, _ in point[:4])
    assert corners == [(0.2, -0.1), (0.2, 0.3), (0.5, -0.1), (0.5, 0.3)]
    np.testing.assert_allclose(point[:4, 2], 0.095, atol=1e-12)


@pytest.mark.parametrize("above", [(0.1, 0.1, 0.1), (0.05, 0.1, 0.1), (0.1, 0.2, 0.1), (0.2, 0.1, 0.1)])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("single", [False, True])
def test_corners_where_outlines_coincide_are_listed_once(above, turned, single):
    """Cubes and bars on a cube, shifted along its sides: all meet at a rectangle."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) if turned else np.eye(3)
    half = np.abs(turn @ above)[:2]
    with jax.enable_x64(not single):
        for shift in ((0.0, 0.0), (0.05, 0.0), (0.0, -0.05), (0.05, 0.05), (-0.12, 0.0)):
            distance, point, _ = one(np.zeros(3), np.eye(3), np.full(3, 0.1), np.array([*shift, 0.199]), turn, above)
            low, high = np.maximum(shift - half, -0.1), np.minimum(shift + half, 0.1)
            corners = sorted((x, y) for x in (low[0], high[0]) for y in (low[1], high[1]))
            found = sorted(map(tuple, np.round(point[distance < 0][:, :2].astype(float), 5)))
            np.testing.assert_allclose(found, corners, atol=1e-5, err_msg=str(shift))


def test_a_side_through_a_corner_is_one_corner(x64):
    """A cube turned by 45 degrees over a corner of another one: the middle of its side is there, two corners outside."""
    c = np.sqrt(0.5)
    turn = np.array([[c, -c, 0.0], [c, c, 0.0], [0.0, 0.0, 1.0]])
    center = np.array([0.5 - 0.2 * c, 0.5 - 0.2 * c, 0.69])
    distance, point, _ = one(np.zeros(3), np.eye(3), np.full(3, 0.5), center, turn, np.full(3, 0.2))
    found = sorted(map(tuple, np.round(point[distance < 0][:, :2], 9)))
    x, y = np.round(0.5 - 0.4 * c, 9), np.round(0.5 - 0.2 * c - 0.2 * c, 9)
    assert len(found) == len(set(found)) and (0.5, 0.5) in found and (x, y) not in found
    assert all(max(abs(a), abs(b)) <= 0.5 for a, b in found)


def test_edges_that_cross_touch_once(x64):
    """Two bars, each turned by 45 degrees about its length, across each other: edge on edge, 1 cm deep."""
    c = np.sqrt(0.5)
    about_x, about_y = np.array([[1, 0, 0], [0, c, -c], [0, c, c]]), np.array([[c, 0, c], [0, 1, 0], [-c, 0, c]])
    first, second = np.array([0.5, 0.1, 0.1]), np.array([0.1, 0.5, 0.1])
    center = np.array([0.03, -0.04, 0.2 / c - 0.01])
    distance, point, normal = one(np.zeros(3), about_x, first, center, about_y, second)
    np.testing.assert_allclose(distance, [-0.01] + 7 * [1.0], atol=1e-12)
    np.testing.assert_allclose(normal, UP, atol=1e-12)
    np.testing.assert_allclose(point[0], [0.03, 0.0, 0.1 / c - 0.005], atol=1e-12)


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences(x64, boxes, derivatives, central_difference, random_like, inner):
    """Of distances, points and normals that touch, with respect to positions, frames and sizes; not where the kind of contact changes."""
    place, _, rotation = boxes
    x = jax.tree.map(jnp.asarray, (place[0], rotation[0], SIZES[0], place[1], rotation[1], SIZES[1]))

    def touching(x):
        distance, point, normal = jax.vmap(box_faces, in_axes=(0, 0, None, 0, 0, None))(*x)
        on = distance < -1e-4
        any_on = jnp.any(on, axis=1)[:, None]
        return jnp.where(on, distance, 0.0), jnp.where(on[..., None], point, 0.0), jnp.where(any_on, normal, 0.0)

    dx = random_like(2, x)
    _, forward, weights, reverse = derivatives(touching, compiler_options=QUICK)(x, dx, lambda v: random_like(3, v))
    expected = central_difference(jax.jit(touching, compiler_options=QUICK), x, dx, 1e-8)
    for found, true in zip(forward, expected, strict=True):
        error = np.abs(found - true).reshape(NUM, -1).max(axis=1)
        assert np.mean(error < 1e-4) > 0.9, np.quantile(error, [0.5, 0.8, 0.9])
    assert inner(weights, forward) == pytest.approx(inner(reverse, dx), rel=1e-9)


def test_derivatives_are_finite_where_boxes_are_aligned():
    """Cubes of one size on each other: outlines coincide, edges are parallel, all corners are equally deep."""
    with jax.enable_x64(False):
        size = jnp.full(3, 0.1)
        inputs = (jnp.zeros(3), jnp.eye(3), size, jnp.array([0.0, 0.0, 0.199]), jnp.eye(3), size)
        slopes = jax.jit(jax.jacrev(box_faces, argnums=range(6)), compiler_options=QUICK)(*inputs)
        assert all(np.isfinite(leaf).all() and np.abs(leaf).max() < 1e3 for leaf in jax.tree.leaves(slopes))
