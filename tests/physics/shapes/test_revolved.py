"""Cylinders and cones: against projections onto them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from shape_cases import SHAPES, H, R, assert_nearest

from rewax.physics.numerics import components as cp


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


@pytest.mark.parametrize("kind", ["cylinder", "cone"])
def test_rounding_does_not_decide_the_normal_on_an_edge(kind):
    """The mean of side and cap for a cylinder, the slant's for a cone; the derivative is not a rounding error's."""
    generator = np.random.default_rng(0)
    angle, noise = generator.uniform(0, 2 * np.pi, 200), generator.uniform(-3e-8, 3e-8, (200, 3))
    points = np.stack([R * np.cos(angle), np.full(200, -H), R * np.sin(angle)], axis=1) + noise

    def normal(p):
        return jnp.stack(SHAPES[kind].distance(cp.split_vector(p))[1])

    up, out = (-1.0, 1.0) if kind == "cylinder" else (R, 2 * H)
    expected = np.stack([out * np.cos(angle), np.full(200, up), out * np.sin(angle)], axis=1) / np.hypot(up, out)
    points = jnp.asarray(points, jnp.float32)
    np.testing.assert_allclose(jax.jit(jax.vmap(normal))(points), expected, atol=1e-5)
    assert np.abs(jax.jit(jax.vmap(jax.jacrev(normal)))(points)).max() < 2.0 / R  # the curvature of the side


def test_three_cones_are_a_cylinder(x64):
    np.testing.assert_allclose(3.0 * SHAPES["cone"].volume(), SHAPES["cylinder"].volume(), rtol=1e-12)
