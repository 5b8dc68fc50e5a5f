"""Rays meet shapes where a march along them does, and normals point outwards."""

import numpy as np
import pytest

from rewax.viz.raycast import hit
from rewax.viz.shapes import support

AXES, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))
CENTER = np.array([0.2, -0.1, 0.3])
SHAPES = {
    "sphere": {"radius": 0.4},
    "capsule": {"radius": 0.2, "half_length": 0.3, "direction": 3.0 * AXES[:, 1]},
    "cylinder": {"radius": 0.25, "half_length": 0.3, "direction": AXES[:, 1]},
    "ellipsoid": {"semi_axes": np.array([0.2, 0.3, 0.4]), "rotation": AXES},
    "cone": {"radius": 0.25, "half_length": 0.3, "direction": AXES[:, 1]},
    "box": {"half_size": np.array([0.2, 0.3, 0.4]), "rotation": AXES},
}


def distance(kind, points):
    """Signed distances of points from the shapes, up to their sign exact (an ellipsoid's is one of a scaled space)."""
    local = (points - CENTER) @ AXES
    if kind == "sphere":
        return np.linalg.norm(local, axis=-1) - 0.4
    if kind == "box":
        return np.max(np.abs(local) - [0.2, 0.3, 0.4], axis=-1)
    if kind == "ellipsoid":
        return np.linalg.norm(local / [0.2, 0.3, 0.4], axis=-1) - 1.0
    across = np.linalg.norm(local[..., [0, 2]], axis=-1)
    if kind == "cone":
        slant = (0.6 * across - 0.25 * (0.3 - local[..., 1])) / np.hypot(0.6, 0.25)
        return np.maximum(slant, -0.3 - local[..., 1])
    if kind == "cylinder":
        return np.maximum(across - 0.25, np.abs(local[..., 1]) - 0.3)
    beyond = local[..., 1] - np.clip(local[..., 1], -0.3, 0.3)
    return np.hypot(across, beyond) - 0.2


@pytest.mark.parametrize("kind", SHAPES)
def test_rays_meet_the_surface_first_where_a_march_does(kind):
    drawing, eye = {"kind": kind, "center": CENTER, **SHAPES[kind]}, np.array([1.5, 1.2, 2.5])
    to = CENTER + np.random.default_rng(0).uniform(-0.6, 0.6, (400, 3))
    rays = (to - eye).astype(np.float32)
    depth, normal = hit(drawing, eye, rays)
    marched = np.linspace(0.0, 2.0, 4001)
    inside = distance(kind, eye + marched[:, None, None] * rays) <= 0.0
    first = np.where(inside.any(axis=0), marched[np.argmax(inside, axis=0)], np.inf)
    met = np.isfinite(depth) & np.isfinite(first)
    assert met.sum() > 50 and np.sum(np.isfinite(depth) != np.isfinite(first)) <= 4  # those that graze
    np.testing.assert_allclose(depth[met], first[met], atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(normal[met], axis=1), 1.0, atol=1e-4)
    assert np.all(np.sum(normal[met] * rays[met], axis=1) < 1e-3)  # they face the eye
    points = eye + depth[met, None] * rays[met]
    assert np.all(distance(kind, points + 0.01 * normal[met]) > 0.005)
    reach = np.abs(points - CENTER).max()
    assert reach <= np.abs(support(drawing, np.concatenate([np.eye(3), -np.eye(3)])) - CENTER).max() + 1e-4


EYE = np.array([1.5, 1.2, 2.5])
RAYS = (np.random.default_rng(1).uniform(-0.4, 0.4, (500, 3)) + CENTER - EYE).astype(np.float32)


def test_rays_meet_an_ellipsoid_where_its_equation_holds_and_normals_are_its_gradient():
    semi_axes = np.array([0.02, 0.5, 0.3])
    drawing = {"kind": "ellipsoid", "center": CENTER, "semi_axes": semi_axes, "rotation": AXES}
    depth, normal = hit(drawing, EYE, RAYS)
    met = np.isfinite(depth)
    assert 50 < met.sum() < 500
    local = (EYE + depth[met, None] * RAYS[met] - CENTER) @ AXES / semi_axes
    np.testing.assert_allclose(np.sum(local**2, axis=1), 1.0, atol=5e-4)
    gradient = local / semi_axes @ AXES.T
    np.testing.assert_allclose(normal[met], gradient / np.linalg.norm(gradient, axis=1, keepdims=True), atol=2e-3)
    start, along = (EYE - CENTER) @ AXES / semi_axes, RAYS[~met] @ AXES / semi_axes
    nearest = start - along * (along @ start / np.sum(along**2, axis=1))[:, None]
    assert np.all(np.sum(nearest**2, axis=1) > 1.0)  # those that miss do miss


def test_an_ellipsoid_of_equal_axes_is_a_sphere():
    ball = {"kind": "sphere", "center": CENTER, "radius": 0.3}
    egg = {"kind": "ellipsoid", "center": CENTER, "semi_axes": np.full(3, 0.3), "rotation": AXES}
    (depth, normal), (expected, outward) = hit(egg, EYE, RAYS), hit(ball, EYE, RAYS)
    met = np.isfinite(expected)
    np.testing.assert_array_equal(np.isfinite(depth), met)
    np.testing.assert_allclose(depth[met], expected[met], atol=2e-5)
    np.testing.assert_allclose(normal[met], outward[met], atol=2e-4)


def test_the_tip_of_a_cone_lies_along_its_direction():
    cone = {"kind": "cone", "center": np.zeros(3), "radius": 0.2, "half_length": 0.5, "direction": (0.0, 0.0, 2.0)}
    ray = np.array([[0.0, 0.0, -1.0]], np.float32)
    for height, x in ((0.499, 0.0), (0.0, 0.1), (-0.499, 0.2)):  # the slant falls from 0.5 at the axis to -0.5 at 0.2
        depth, _ = hit(cone, np.array([max(x, 1e-4) * 0.999, 0.0, 2.0]), ray)
        assert 2.0 - depth[0] == pytest.approx(height, abs=3e-3)
    depth, normal = hit(cone, np.array([0.1, 0.05, -2.0]), -ray)
    assert depth[0] == pytest.approx(1.5, abs=1e-5)
    np.testing.assert_allclose(normal[0], [0.0, 0.0, -1.0], atol=1e-6)


def test_nothing_behind_the_eye_is_met():
    drawing = {"kind": "sphere", "center": np.array([0.0, 0.0, 5.0]), "radius": 1.0}
    assert np.isinf(hit(drawing, np.zeros(3), np.array([[0.0, 0.0, -1.0]], np.float32))[0]).all()
