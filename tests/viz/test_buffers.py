"""The nearest thing in every pixel, known by hand."""

import numpy as np
import pytest

from rewax.viz.buffers import NearestBuffer


def picture(buffer, value=-1.0):
    """What is shown in each pixel, and how deep."""
    pixels, which, depth = buffer.result()
    shown, deep = np.full(buffer.height * buffer.width, -1), np.full(buffer.height * buffer.width, value)
    shown[pixels], deep[pixels] = which, depth
    return shown.reshape(buffer.height, buffer.width), deep.reshape(buffer.height, buffer.width)


def test_discs_have_their_area_and_the_nearer_one_covers():
    buffer = NearestBuffer(60, 80)
    columns, rows, radii = np.array([30.2, 40.0, -20.0]), np.array([30.7, 30.0, 10.0]), np.array([10.0, 12.0, 5.0])
    buffer.add_spheres(columns, rows, np.array([2.0, 1.0, 1.0]), radii)
    shown, depth = picture(buffer)
    assert np.sum(shown == 1) == pytest.approx(np.pi * 144.0, rel=0.03)
    both = (np.hypot(*(np.mgrid[:60, :80] + 0.5 - np.array([30.7, 30.2])[:, None, None])) <= 10.0) & (shown == 1)
    assert both.sum() > 50 and np.all(depth[shown == 0] == 2.0) and not np.any(shown == 2)


def test_triangles_cover_their_pixels_whichever_way_they_go_and_depth_is_that_of_the_plane():
    corners = np.array([[4.0, 4.0, 1.0], [44.0, 4.0, 2.0], [4.0, 34.0, 2.0]])
    for order in ([0, 1, 2], [2, 1, 0]):
        buffer = NearestBuffer(40, 50)
        buffer.add_triangles(corners[order][None])
        shown, depth = picture(buffer)
        assert np.sum(shown == 0) == pytest.approx(600.0, rel=0.05)
        # The inverse of the depth is linear in the picture: half way along an edge it is the mean of the ends'.
        assert depth[4, 23] == pytest.approx(1.0 / 0.75, rel=0.02)
        assert shown[30, 40] == -1


def test_many_small_triangles_and_one_large_one_meet_in_one_picture():
    small = np.array([[1.0, 1.0, 3.0], [3.0, 1.0, 3.0], [1.0, 3.0, 3.0]]) + np.arange(10)[:, None, None] * [
        4.0,
        0.0,
        0.0,
    ]
    large = np.array([[0.0, 0.0, 4.0], [200.0, 0.0, 4.0], [0.0, 200.0, 4.0]])[None]
    buffer = NearestBuffer(64, 64)
    buffer.add_triangles(np.concatenate([small, large]))
    shown, _ = picture(buffer)
    assert set(np.unique(shown)) == set(range(11))
    assert np.sum(shown == 10) > 64 * 64 - 60
