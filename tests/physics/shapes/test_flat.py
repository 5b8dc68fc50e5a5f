"""Boxes and half-spaces: against projections onto them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as hs
from shape_cases import HALF, SHAPES, assert_nearest

from rewax.physics.shapes import Box, fill


@given(seed=hs.integers(0, 10_000))
def test_distance_of_a_box_is_the_one_to_the_nearest_point(x64, seed):
    assert_nearest(SHAPES["box"], seed, lambda p: np.clip(p, -HALF, HALF), lambda p: (HALF - np.abs(p)).min(axis=1))


@given(seed=hs.integers(0, 10_000))
def test_distance_of_a_plane_is_the_height(x64, seed):
    assert_nearest(SHAPES["plane"], seed, lambda p: np.minimum(p, [np.inf, 0.0, np.inf]), lambda p: -p[:, 1])


def test_a_box_is_filled_from_face_to_face():
    """0.3 m in steps of about 0.11 m: three of 0.1 m, the first and last one half a step from a face."""
    x = fill(Box(half_size=(0.15, 0.05, 0.05)), 0.11)
    np.testing.assert_allclose(x, [[-0.1, 0, 0], [0, 0, 0], [0.1, 0, 0]], atol=1e-8)
