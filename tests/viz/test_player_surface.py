"""The page computes the surfaces that pictures show."""

import json
import subprocess

import numpy as np
import pytest
import recordings
from javascript import NODE, needs_node

from rewax.viz import player
from rewax.viz.surface import surfaces

SPACING = 0.05
SCRIPT = """
const { points, diameter, values } = JSON.parse(require("fs").readFileSync(0));
const found = particleSurface(Float32Array.from(points), diameter, values && Float32Array.from(values));
process.stdout.write(JSON.stringify(Object.fromEntries(Object.entries(found).map(([k, v]) => [k, v && Array.from(v)]))));
"""


def ball(extra=()):
    axis = np.arange(-8, 9) * SPACING
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    points = np.concatenate([points[np.linalg.norm(points, axis=1) <= 0.3], np.reshape(extra, (-1, 3))])
    return points.astype(np.float32)


def in_node(points, diameter, values=None):
    """The surface that the page's script computes."""
    data = {"points": points.reshape(-1).tolist(), "diameter": diameter, "values": values}
    script = (player.Path(player.__file__).parent / "player_surface.js").read_text() + SCRIPT
    done = subprocess.run([NODE, "-e", script], input=json.dumps(data), capture_output=True, text=True, check=True)
    return {name: None if value is None else np.array(value) for name, value in json.loads(done.stdout).items()}


def diameter_of(points):
    from rewax.viz.recording import diameters

    return float(diameters(recordings.made(1, particles=points[None])).mean())


@needs_node
def test_vertices_normals_triangles_and_lone_particles_are_those_of_numpy():
    points = ball(extra=[[0.8, 0.5, 0.0], [-0.7, 0.0, 0.1]])
    (expected,) = surfaces(recordings.made(1, particles=points[None]), 0)
    found = in_node(points, diameter_of(points))
    assert found["loose"].tolist() == expected.loose.tolist() == [len(points) - 2, len(points) - 1]
    vertices, normals = found["vertices"].reshape(-1, 3), found["normals"].reshape(-1, 3)
    assert len(vertices) == len(expected.vertices) > 500 and len(found["triangles"]) == expected.triangles.size
    order, expected_order = np.lexsort(vertices.round(4).T), np.lexsort(expected.vertices.round(4).T)
    np.testing.assert_allclose(vertices[order], expected.vertices[expected_order], atol=1e-4 * SPACING + 2e-5)
    np.testing.assert_allclose(normals[order], expected.normals[expected_order], atol=1e-3)
    for corners in (vertices[found["triangles"].astype(int).reshape(-1, 3)], expected.vertices[expected.triangles]):
        enclosed = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
        assert enclosed == pytest.approx(4.0 / 3.0 * np.pi * 0.32**3, rel=0.15)  # positive: outwards


@needs_node
def test_values_on_the_surface_are_means_of_the_particles_nearby():
    points = ball()
    found = in_node(points, diameter_of(points), values=points[:, 0].tolist())
    x = found["vertices"].reshape(-1, 3)[:, 0]
    assert np.corrcoef(x, found["values"])[0, 1] > 0.99
    assert np.abs(found["values"]).max() <= 0.3 + 1e-6
    constant = in_node(points, diameter_of(points), values=[0.25] * len(points))
    np.testing.assert_allclose(constant["values"], 0.25, atol=1e-5)


@needs_node
def test_many_particles_in_one_place_still_have_a_closed_surface_with_normals():
    points = np.concatenate([ball(), np.full((20000, 3), 0.3, np.float32)])
    found = in_node(points, 0.06)
    assert np.all(np.isfinite(found["normals"])) and np.all(np.isfinite(found["vertices"]))
    triangles = found["triangles"].astype(int).reshape(-1, 3)
    edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    np.testing.assert_array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
