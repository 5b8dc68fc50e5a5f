"""Cylinders and cones: against projections onto them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as hs
from shape_cases import SHAPES, H, R, assert_nearest


def radial(p):
    return np.hypot(p[:, 0], p[:, 2])


def half_plane(p):
    return np.stack([radial(p), p[:, 1]], axis=1)


def cone_outline(p):
    """Nearest points, in the half-plane (r, y), of the base and of the slant, shape (n, 2, 2)."""
    out = []
    for start, end in (([0.0, -H], [R, -H]), ([R, -H], [0.0, H])):
        start, way = np.array(start), np.subtract(end, start)
        out.append(start + np.clip((half_plane(p) - start) @ way / (way @ way), 0, 1)[:, None] * way)
    return np.stack(out, axis=1)


def onto_cone(p):
    inside = (np.abs(p[:, 1]) <= H) & (radial(p) <= R * (H - p[:, 1]) / (2 * H))
    outline = cone_outline(p)
    nearest = outline[np.arange(len(p)), np.argmin(np.linalg.norm(outline - half_plane(p)[:, None], axis=2), axis=1)]
    turned = p * (nearest[:, 0] / radial(p))[:, None]
    turned[:, 1] = nearest[:, 1]
    return np.where(inside[:, None], p, turned)


def onto_cylinder(p):
    q = p * np.minimum(1.0, R / radial(p))[:, None]
    q[:, 1] = np.clip(p[:, 1], -H, H)
    return q


@given(seed=hs.integers(0, 10_000))
def test_distance_of_a_cylinder_is_the_one_to_the_nearest_point(x64, seed):
    assert_nearest(SHAPES["cylinder"], seed, onto_cylinder, lambda p: np.minimum(R - radial(p), H - np.abs(p[:, 1])))


@given(seed=hs.integers(0, 10_000))
def test_distance_of_a_cone_is_the_one_to_the_nearest_point(x64, seed):
    def depth(p):
        return np.linalg.norm(cone_outline(p) - half_plane(p)[:, None], axis=2).min(axis=1)

    assert_nearest(SHAPES["cone"], seed, onto_cone, depth)


def test_three_cones_are_a_cylinder(x64):
    np.testing.assert_allclose(3.0 * SHAPES["cone"].volume(), SHAPES["cylinder"].volume(), rtol=1e-12)
