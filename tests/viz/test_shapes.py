"""Outlines and extents of shapes: where their farthest points are, known by hand or found among points inside."""

import numpy as np
import pytest

from rewax.viz import shapes

CAPSULE = {"kind": "capsule", "centre": (0.5, 0.2, 0.5), "radius": 0.05, "half_length": 0.2, "direction": (0, 0, 3.0)}
SIDE, TOP = shapes.View(np.eye(3)[0], np.eye(3)[1]), shapes.View(np.eye(3)[0], np.eye(3)[2])


def turned(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diagonal(r))
    return q * np.sign(np.linalg.det(q))


def inside(kind, rng, num):
    """Points of the extremes of a shape about the origin whose axis is z: radius 0.3, half length 0.5 (half sizes 0.3,
    0.2, 0.5)."""
    ball = rng.standard_normal((num, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    slide = rng.uniform(-0.5, 0.5, (num, 1)) * [0, 0, 1]
    disc = ball[:, :2] / np.linalg.norm(ball[:, :2], axis=1, keepdims=True)
    return {
        "sphere": 0.3 * ball,
        "capsule": 0.3 * ball + 0.5 * np.sign(slide),
        "cylinder": np.concatenate([0.3 * disc, np.sign(slide[:, 2:]) * 0.5], axis=1),
        "box": np.sign(ball) * [0.3, 0.2, 0.5],
    }[kind]


def shape(kind, rotation, centre):
    made = {"kind": kind, "centre": centre}
    if kind == "box":
        return {**made, "rotation": rotation, "half_sizes": np.array([0.3, 0.2, 0.5])}
    return {**made, "radius": 0.3, "half_length": 0.5, "direction": 2.0 * rotation[:, 2]}


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder", "box"])
def test_nothing_of_a_shape_lies_beyond_its_support_and_something_at_it(kind):
    rng, rotation, centre = np.random.default_rng(1), turned(2), np.array([1.0, -2.0, 3.0])
    points = inside(kind, rng, 60_000) @ rotation.T + centre
    directions = turned(3)
    reach = np.sum(shapes.support(shape(kind, rotation, centre), directions) * directions, axis=1)
    farthest = (points @ directions.T).max(axis=0)
    assert np.all(farthest <= reach + 1e-12)
    np.testing.assert_allclose(farthest, reach, atol=5e-3)


def test_a_capsule_seen_along_its_axis_and_across():
    for view, centre, reach in ((SIDE, (0.5, 0.2), (0.05, 0.05)), (TOP, (0.5, 0.5), (0.05, 0.25))):
        points = shapes.outline(CAPSULE, view)
        np.testing.assert_allclose(points.max(axis=0), np.add(centre, reach), atol=1e-12)
        np.testing.assert_allclose(points.min(axis=0), np.subtract(centre, reach), atol=1e-12)


def test_outlines_go_around_once():
    """Shoelace areas: a disc, and the hexagon that a cube on its corner shows, sqrt(3) times its face."""

    def area(points):
        x, y = points.T
        return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))

    disc = shapes.outline({"kind": "sphere", "centre": np.ones(3), "radius": 2.0}, SIDE, num_points=1000)
    assert area(disc) == pytest.approx(4.0 * np.pi, rel=1e-4)
    diagonal = np.ones(3) / np.sqrt(3.0)
    right = np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    view = shapes.View(right, np.cross(diagonal, right))
    np.testing.assert_allclose(view.towards, diagonal, atol=1e-12)
    cube = {"kind": "box", "centre": np.zeros(3), "rotation": np.eye(3), "half_sizes": 0.5 * np.ones(3)}
    assert area(shapes.outline(cube, view)) == pytest.approx(np.sqrt(3.0))


def test_bounds_hold_every_shape_but_planes():
    plane = {"kind": "plane", "centre": (9.0, 9.0, 9.0), "direction": (0.0, 1.0, 0.0)}
    ball = {"kind": "sphere", "centre": (-1.0, 0.0, 0.0), "radius": 0.5}
    low, high = shapes.bounds([plane, ball, CAPSULE])
    np.testing.assert_allclose([low, high], [[-1.5, -0.5, -0.5], [0.55, 0.5, 0.75]])
    low, high = shapes.bounds([plane])
    assert np.all(low > high)


@pytest.mark.parametrize(
    ("up", "right", "towards"),
    [
        ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
        ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
        ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
        ((0.6, 0, 0.8), (0.8, 0, -0.6), (0, -1, 0)),
    ],
)
def test_side_views_keep_up_up(up, right, towards):
    view = shapes.side_view(up)
    np.testing.assert_allclose([view.right, view.up, view.towards], [right, up, towards], atol=1e-12)
    np.testing.assert_allclose(
        view.project(np.array([[1.0, 2.0, 3.0]])), [[np.dot(right, [1, 2, 3]), np.dot(up, [1, 2, 3])]]
    )
