"""Outlines and extents of shapes: where their farthest points are, known by hand or found among points inside."""

import re

import numpy as np
import pytest

from rewax.viz import shapes

CAPSULE = {"kind": "capsule", "center": (0.5, 0.2, 0.5), "radius": 0.05, "half_length": 0.2, "direction": (0, 0, 3.0)}
SIDE, TOP = shapes.View(np.eye(3)[0], np.eye(3)[1]), shapes.View(np.eye(3)[0], np.eye(3)[2])


def turned(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diagonal(r))
    return q * np.sign(np.linalg.det(q))


CORNERS = np.random.default_rng(8).uniform(-0.5, 0.5, (30, 3))


def inside(kind, rng, num):
    """Points of the extremes of a shape about the origin whose axis is z: radius 0.3, half length 0.5 (half sizes and
    semi-axes 0.3, 0.2, 0.5)."""
    ball = rng.standard_normal((num, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    slide = rng.uniform(-0.5, 0.5, (num, 1)) * [0, 0, 1]
    disc = ball[:, :2] / np.linalg.norm(ball[:, :2], axis=1, keepdims=True)
    return {
        "sphere": 0.3 * ball,
        "capsule": 0.3 * ball + 0.5 * np.sign(slide),
        "cylinder": np.concatenate([0.3 * disc, np.sign(slide[:, 2:]) * 0.5], axis=1),
        "box": np.sign(ball) * [0.3, 0.2, 0.5],
        "ellipsoid": ball * [0.3, 0.2, 0.5],
        "cone": np.concatenate([0.3 * disc, np.full((num, 1), -0.5)], axis=1) * (slide[:, 2:] < 0.4)
        + [0, 0, 0.5] * (slide[:, 2:] >= 0.4),
        "mesh": rng.dirichlet(np.full(len(CORNERS), 0.02), num) @ CORNERS,
    }[kind]


def shape(kind, rotation, center):
    made = {"kind": kind, "center": center}
    if kind in ("box", "ellipsoid"):
        return {**made, "rotation": rotation, "half_size" if kind == "box" else "semi_axes": np.array([0.3, 0.2, 0.5])}
    if kind == "mesh":
        return {**made, "rotation": rotation, "vertices": CORNERS, "triangles": np.arange(30).reshape(-1, 3)}
    return {**made, "radius": 0.3, "half_length": 0.5, "direction": 2.0 * rotation[:, 2]}


@pytest.mark.parametrize("kind", [kind for kind in shapes.KEYS if kind != "plane"])
def test_nothing_of_a_shape_lies_beyond_its_support_and_something_at_it(kind):
    rng, rotation, center = np.random.default_rng(1), turned(2), np.array([1.0, -2.0, 3.0])
    points = inside(kind, rng, 60_000) @ rotation.T + center
    directions = turned(3)
    reach = np.sum(shapes.support(shape(kind, rotation, center), directions) * directions, axis=1)
    farthest = (points @ directions.T).max(axis=0)
    assert np.all(farthest <= reach + 1e-12)
    np.testing.assert_allclose(farthest, reach, atol=5e-3)


def test_a_capsule_seen_along_its_axis_and_across():
    for view, center, reach in ((SIDE, (0.5, 0.2), (0.05, 0.05)), (TOP, (0.5, 0.5), (0.05, 0.25))):
        points = shapes.outline(CAPSULE, view)
        np.testing.assert_allclose(points.max(axis=0), np.add(center, reach), atol=1e-12)
        np.testing.assert_allclose(points.min(axis=0), np.subtract(center, reach), atol=1e-12)


def test_outlines_go_around_once():
    """Shoelace areas: a disc, and the hexagon that a cube on its corner shows, sqrt(3) times its face."""

    def area(points):
        x, y = points.T
        return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))

    disc = shapes.outline({"kind": "sphere", "center": np.ones(3), "radius": 2.0}, SIDE, num_points=1000)
    assert area(disc) == pytest.approx(4.0 * np.pi, rel=1e-4)
    egg = {"kind": "ellipsoid", "center": np.ones(3), "semi_axes": np.array([1.0, 0.5, 3.0]), "rotation": turned(4)}
    round_ = np.linalg.inv(egg["rotation"] * egg["semi_axes"] ** 2 @ egg["rotation"].T)  # x^T round_ x = 1
    shadow = round_[:2, :2] - np.outer(round_[:2, 2], round_[2, :2]) / round_[2, 2]
    assert area(shapes.outline(egg, SIDE, num_points=1000)) == pytest.approx(
        np.pi / np.sqrt(np.linalg.det(shadow)), rel=1e-3
    )
    diagonal = np.ones(3) / np.sqrt(3.0)
    right = np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    view = shapes.View(right, np.cross(diagonal, right))
    np.testing.assert_allclose(view.towards, diagonal, atol=1e-12)
    cube = {"kind": "box", "center": np.zeros(3), "rotation": np.eye(3), "half_size": 0.5 * np.ones(3)}
    assert area(shapes.outline(cube, view)) == pytest.approx(np.sqrt(3.0))


def test_bounds_hold_every_shape_but_planes():
    plane = {"kind": "plane", "center": (9.0, 9.0, 9.0), "direction": (0.0, 1.0, 0.0)}
    ball = {"kind": "sphere", "center": (-1.0, 0.0, 0.0), "radius": 0.5}
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


BOX = {"kind": "box", "center": (0, 0, 0), "half_size": (1, 2, 3), "rotation": np.eye(3)}
MESH = {"kind": "mesh", "center": (0, 0, 0), "vertices": np.eye(4, 3), "triangles": [(0, 1, 2)], "rotation": np.eye(3)}
KINDS = "'sphere', 'ellipsoid', 'capsule', 'cylinder', 'cone', 'box', 'mesh', 'plane'"
WRONG = {
    f"cannot draw a shape of kind 'torus': use one of {KINDS}": {"kind": "torus"},
    f"cannot draw a shape of kind None: use one of {KINDS}": {"center": (0, 0, 0)},
    "a drawing is 3: give a dict with kind, center and the keys of that kind": 3,
    "the drawing of a box has no 'half_size', but has 'half_sizes': give it center, half_size, rotation": {
        **{key: value for key, value in BOX.items() if key != "half_size"}, "half_sizes": (1, 2, 3)
    },
    "the drawing of a plane has no 'direction': give it center, direction": {"kind": "plane", "center": (0, 0, 0)},
    "half_size of the drawing of a box has shape (2,): give (3,)": {**BOX, "half_size": (1, 2)},
    "rotation of the drawing of a box has shape (4,): give (3, 3)": {**BOX, "rotation": (1, 0, 0, 0)},
    "center of the drawing of a box is [0.0, nan, 0.0]: give finite numbers": {**BOX, "center": (0, np.nan, 0)},
    "radius of the drawing of a capsule is -0.1: give 0 or more": {**CAPSULE, "radius": -0.1},
    "radius of the drawing of a capsule is 'thick': give numbers": {**CAPSULE, "radius": "thick"},
    "semi_axes of the drawing of an ellipsoid is [1.0, 0.0, 2.0]: give more than 0": {
        "kind": "ellipsoid", "center": (0, 0, 0), "semi_axes": (1, 0, 2), "rotation": np.eye(3)
    },
    "the drawing of a cone has no 'radius': give it center, radius, half_length, direction": {"kind": "cone", "center": (0, 0, 0)},
    "vertices of the drawing of a mesh has shape (2, 2): give (n, 3) with n > 0": {**MESH, "vertices": np.zeros((2, 2))},
    "vertices of the drawing of a mesh holds a number that is not finite: give finite numbers": {
        **MESH, "vertices": np.full((4, 3), np.nan)
    },
    "triangles of the drawing of a mesh has shape (0, 3): give (n, 3) with n > 0": {**MESH, "triangles": np.zeros((0, 3), int)},
    "triangles of the drawing of a mesh holds 4: give integers from 0 to 3, indices of its vertices": {
        **MESH, "triangles": [(0, 1, 2), (2, 3, 4)]
    },
    "triangles of the drawing of a mesh holds -1: give integers from 0 to 3, indices of its vertices": {
        **MESH, "triangles": [(0, 1, -1)]
    },
    "triangles of the drawing of a mesh holds 0.5: give integers from 0 to 3, indices of its vertices": {
        **MESH, "triangles": [(0, 1, 0.5)]
    },
    "direction of the drawing of a capsule is zero: give a vector of any other length": {**CAPSULE, "direction": (0, 0, 0)},
}  # fmt: skip


@pytest.mark.parametrize("sentence", WRONG, ids=range(len(WRONG)))
def test_a_wrong_drawing_is_one_sentence(sentence):
    for use in (shapes.check_drawing, lambda drawing: shapes.bounds([drawing])):
        with pytest.raises(ValueError) as caught:
            use(WRONG[sentence])
        assert str(caught.value) == sentence


def test_the_table_lists_what_is_checked():
    for kind, keys in shapes.KEYS.items():
        (row,) = [line for line in shapes.__doc__.splitlines() if line.startswith(f"``{kind}``")]
        assert set(re.findall(r"\w+", row.split("``")[3])) == set(keys) - {"center"}


@pytest.mark.parametrize("cloud", [np.zeros(3), np.zeros((4, 2)), np.zeros((0, 3)), np.full((2, 3), np.inf)])
def test_particles_that_cannot_be_drawn_are_refused(cloud):
    with pytest.raises(ValueError, match=r"particles (have shape|hold a number that is not finite)"):
        shapes.check_cloud(cloud)
