"""Meshes of shapes are closed, face outwards and have the shapes' volumes; poses turn them to where they are."""

import numpy as np
import pytest

from rewax.viz.meshes import mesh, pose
from rewax.viz.shapes import support

CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
FACES = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
"""Squares of the cube, counter-clockwise from outside."""
TRIANGLES = np.concatenate([FACES[:, :3], FACES[:, [0, 2, 3]]])
TURN, _ = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))
TURN = TURN * np.sign(np.linalg.det(TURN))
SHAPES = [
    ({"kind": "sphere", "center": np.ones(3), "radius": 0.3}, 4 / 3 * np.pi * 0.027),
    ({"kind": "capsule", "center": np.ones(3), "radius": 0.2, "half_length": 0.5, "direction": TURN[:, 2]},
     np.pi * 0.04 * 1.0 + 4 / 3 * np.pi * 0.008),
    ({"kind": "capsule", "center": np.ones(3), "radius": 0.2, "half_length": 0.5, "direction": (0.0, -2.0, 0.0)},
     np.pi * 0.04 * 1.0 + 4 / 3 * np.pi * 0.008),
    ({"kind": "cylinder", "center": np.ones(3), "radius": 0.2, "half_length": 0.5, "direction": TURN[:, 0]}, np.pi * 0.04),
    ({"kind": "cone", "center": np.ones(3), "radius": 0.2, "half_length": 0.5, "direction": TURN[:, 0]}, np.pi * 0.04 / 3),
    ({"kind": "ellipsoid", "center": np.ones(3), "semi_axes": np.array([0.1, 0.2, 0.4]), "rotation": TURN},
     4 / 3 * np.pi * 0.008),
    ({"kind": "mesh", "center": np.ones(3), "vertices": CUBE * [0.1, 0.2, 0.4], "triangles": TRIANGLES, "rotation": TURN},
     0.064),
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


def test_edges_of_a_mesh_stay_sharp_and_what_is_round_is_shaded_round():
    cube = mesh({"kind": "mesh", "vertices": CUBE, "triangles": TRIANGLES})
    assert len(cube.vertices) == 24  # each corner once for each of its three faces
    np.testing.assert_allclose(np.abs(cube.normals).max(axis=1), 1.0, atol=1e-6)
    repeated = mesh(
        {"kind": "mesh", "vertices": CUBE[TRIANGLES].reshape(-1, 3), "triangles": np.arange(36).reshape(-1, 3)}
    )
    assert len(repeated.vertices) == 24
    ball = mesh({"kind": "sphere", "radius": 1.0})
    again = mesh({"kind": "mesh", "vertices": np.round(ball.vertices, 9), "triangles": ball.triangles})
    assert np.einsum("ni,ni->n", again.vertices, again.normals).min() > 0.99


def test_every_rotation_has_its_quaternion():
    for seed in range(20):
        q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
        q = q * np.sign(np.linalg.det(q)) if seed else np.diag([-1.0, -1.0, 1.0])
        box = {"kind": "box", "center": np.zeros(3), "half_size": np.ones(3), "rotation": q}
        np.testing.assert_allclose(turned(np.eye(3), pose(box)[1]), q.T, atol=1e-12)
