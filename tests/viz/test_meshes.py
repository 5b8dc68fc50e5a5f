"""Meshes of shapes are closed, face outwards and have the shapes' volumes; poses turn them to where they are."""

import numpy as np
import pytest

from rewax.viz.meshes import mesh, pose
from rewax.viz.shapes import support

TURN, _ = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))
TURN = TURN * np.sign(np.linalg.det(TURN))
SHAPES = [
    ({"kind": "sphere", "center": np.ones(3), "radius": 0.3}, 4 / 3 * np.pi * 0.027),
    ({"kind": "capsule", "center": np.ones(3), "radius": 0.2, "half_length": 0.5, "direction": TURN[:, 2]},
     np.pi * 0.04 * 1.0 + 4 / 3 * np.pi * 0.008),
    ({"kind": "capsule", "center": np.ones(3), "radius": 0.2, "half_length": 0.5, "direction": (0.0, -2.0, 0.0)},
     np.pi * 0.04 * 1.0 + 4 / 3 * np.pi * 0.008),
    ({"kind": "cylinder", "center": np.ones(3), "radius": 0.2, "half_length": 0.5, "direction": TURN[:, 0]}, np.pi * 0.04),
    ({"kind": "box", "center": np.ones(3), "half_size": np.array([0.1, 0.2, 0.4]), "rotation": TURN}, 0.064),
]  # fmt: skip


def turned(points, quaternion):
    vector, real = quaternion[:3], quaternion[3]
    return points + 2.0 * np.cross(vector, np.cross(vector, points) + real * points)


@pytest.mark.parametrize(("drawing", "volume"), SHAPES)
def test_volume_normals_and_extent(drawing, volume):
    surface, (center, quaternion) = mesh(drawing), pose(drawing)
    corners = surface.vertices[surface.triangles]
    found = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    assert found == pytest.approx(volume, rel=0.04) and found <= volume * 1.0001  # positive: they face outwards
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.einsum("tci,ti->tc", surface.normals[surface.triangles], faces) >= -1e-12)
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0, atol=1e-12)
    placed = center + turned(surface.vertices, quaternion)
    for direction in np.concatenate([np.eye(3), TURN.T]):
        reach = support(drawing, direction) @ direction
        assert reach - 0.01 < (placed @ direction).max() <= reach + 1e-9


def test_every_rotation_has_its_quaternion():
    for seed in range(20):
        q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
        q = q * np.sign(np.linalg.det(q)) if seed else np.diag([-1.0, -1.0, 1.0])
        box = {"kind": "box", "center": np.zeros(3), "half_size": np.ones(3), "rotation": q}
        np.testing.assert_allclose(turned(np.eye(3), pose(box)[1]), q.T, atol=1e-12)
