"""Surfaces around particles: where they lie, which way they face, what flies alone, and the pictures of them."""

import numpy as np
import pytest
import recordings

from rewax.viz import surface
from rewax.viz.recording import diameters
from rewax.viz.render import pictures
from rewax.viz.surface import has_surfaces, surfaces

SPACING = 0.05


def ball(radius=0.4, extra=()):
    """A ball of a lattice of particles about the origin, and others."""
    axis = np.arange(-10, 11) * SPACING
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return np.concatenate([points[np.linalg.norm(points, axis=1) <= radius], np.reshape(extra, (-1, 3))])


def made(points, **options):
    return recordings.made(1, particles=points[None].astype(np.float32), **options)


def test_a_ball_of_particles_has_the_surface_and_volume_of_a_ball():
    (found,) = surfaces(made(ball()), 0)
    radius = np.linalg.norm(found.vertices, axis=1)
    assert radius.mean() == pytest.approx(0.4, abs=0.5 * SPACING) and np.ptp(radius) < SPACING
    a, b, c = (found.vertices[found.triangles[:, i]] for i in range(3))
    volume = np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6.0  # positive: counter-clockwise from outside
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * radius.mean() ** 3, rel=0.03)
    outward = np.einsum("ni,ni->n", found.normals, found.vertices / radius[:, None])
    assert outward.min() > 0.8 and np.allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-3)
    assert len(found.loose) == 0


def test_every_edge_belongs_to_two_triangles():
    (found,) = surfaces(made(ball()), 0)
    edges = np.sort(np.concatenate([found.triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert np.all(counts == 2)


def test_a_drop_that_flies_alone_is_loose_and_each_material_has_its_own_surface():
    points = ball(extra=[[1.0, 0.5, 0.0]])
    (found,) = surfaces(made(points), 0)
    assert found.loose.tolist() == [len(points) - 1]
    halves = (points[:, 0] > 0.0).astype(int)
    left, right = surfaces(made(points, materials=halves, material_names=("water", "sand")), 0)
    border = 0.5 * SPACING  # halfway between the last particles of either side
    assert (
        abs(left.vertices[:, 0].max() - border) < SPACING and abs(right.vertices[:, 0].min() - border) < 1.5 * SPACING
    )
    assert set(halves[left.nearest]) == {0} and set(halves[right.nearest]) == {1}


def test_far_splashes_do_not_make_grids_without_end():
    points = ball(extra=[[200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 200.0]])
    (found,) = surfaces(made(points), 0)
    assert np.all(np.isfinite(found.vertices))


def test_pictures_show_the_surface_in_the_colour_of_its_material():
    points = ball(extra=[[0.0, 0.8, 0.0]]) + [0.0, 0.5, 0.0]
    recording = made(points, material_names=("water",), floor=0.0)
    spheres, surface = (
        next(pictures(recording, size=(120, 160), renderer="software", surface=on)).astype(float)
        for on in (False, True)
    )
    blue = [image[..., 2] > image[..., 0] + 60 for image in (spheres, surface)]
    assert blue[1].sum() == pytest.approx(blue[0].sum(), rel=0.15)
    inside = blue[1][40:-20] & np.roll(blue[1], 3, 0)[40:-20] & np.roll(blue[1], -3, 0)[40:-20]
    rough = [np.abs(np.diff(image.mean(axis=-1)[40:-20], axis=1))[inside[:, 1:]].mean() for image in (spheres, surface)]
    assert rough[1] < 0.6 * rough[0]  # smooth where spheres are bumpy
    assert blue[1][:40].any()  # the drop


def test_sizes_of_particles_are_computed_once_for_all_frames(monkeypatch):
    recording = made(ball(), floor=0.0)
    (expected,) = surfaces(recording, 0)
    sizes = diameters(recording)
    monkeypatch.setattr(surface, "diameters", None)
    (found,) = surfaces(recording, 0, sizes=sizes)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    assert next(pictures(recording, size=(30, 40), renderer="software", surface=True)).std() > 0.0


def test_a_mesh_keeps_its_own_surface():
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    meshed = made(corners, triangles=np.array([[0, 1, 2]]))
    assert not has_surfaces(meshed)
    plain, asked = (next(pictures(meshed, size=(60, 80), renderer="software", surface=on)) for on in (False, True))
    np.testing.assert_array_equal(plain, asked)


def test_surfaces_are_the_default_where_the_renderer_draws_them():
    recording = made(ball(), floor=0.0)
    plain, asked, balls = (next(pictures(recording, size=(60, 80), surface=surface)) for surface in (None, True, False))
    np.testing.assert_array_equal(plain, asked)
    assert not np.array_equal(plain, balls)


def test_the_renderer_that_draws_no_surfaces_says_so():
    with pytest.raises(ValueError, match="mujoco draws no surfaces of particles: use software or auto"):
        pictures(made(ball()), renderer="mujoco", surface=True)
