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
    "box": {"half_size": np.array([0.2, 0.3, 0.4]), "rotation": AXES},
}


def distance(kind, points):
    """Signed distances of points from the shapes, up to their sign exact."""
    local = (points - CENTER) @ AXES
    if kind == "sphere":
        return np.linalg.norm(local, axis=-1) - 0.4
    if kind == "box":
        return np.max(np.abs(local) - [0.2, 0.3, 0.4], axis=-1)
    across = np.linalg.norm(local[..., [0, 2]], axis=-1)
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


def test_nothing_behind_the_eye_is_met():
    drawing = {"kind": "sphere", "center": np.array([0.0, 0.0, 5.0]), "radius": 1.0}
    assert np.isinf(hit(drawing, np.zeros(3), np.array([[0.0, 0.0, -1.0]], np.float32))[0]).all()
