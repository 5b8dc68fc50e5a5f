"""Signed distances against projections onto each shape, and normals against the distance's own derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics import sdf

NUM = 64
R, H, HALF = 0.4, 0.7, np.array([0.3, 0.5, 0.8])
SHAPES = {
    "sphere": sdf.Sphere(radius=R),
    "capsule": sdf.Capsule(radius=R, half_length=H),
    "box": sdf.Box(half_size=HALF),
    "cylinder": sdf.Cylinder(radius=R, half_length=H),
    "plane": sdf.Plane(),
}


def radial(p):
    return np.hypot(p[:, 0], p[:, 2])


def project(name: str, p: np.ndarray) -> np.ndarray:
    """Nearest point of the solid."""
    if name == "sphere":
        return p * np.minimum(1.0, R / np.linalg.norm(p, axis=1))[:, None]
    if name == "box":
        return np.clip(p, -HALF, HALF)
    if name == "plane":
        return np.minimum(p, [np.inf, 0.0, np.inf])
    if name == "cylinder":
        q = p * np.minimum(1.0, R / radial(p))[:, None]
        q[:, 1] = np.clip(p[:, 1], -H, H)
        return q
    on_axis = np.stack([0 * p[:, 0], np.clip(p[:, 1], -H, H), 0 * p[:, 0]], axis=1)
    away = p - on_axis
    return on_axis + away * np.minimum(1.0, R / np.linalg.norm(away, axis=1))[:, None]


def depth(name: str, p: np.ndarray) -> np.ndarray:
    """Distance of a point inside from the nearest piece of the surface."""
    if name == "sphere":
        return R - np.linalg.norm(p, axis=1)
    if name == "box":
        return (HALF - np.abs(p)).min(axis=1)
    if name == "plane":
        return -p[:, 1]
    if name == "cylinder":
        return np.minimum(R - radial(p), H - np.abs(p[:, 1]))
    return R - np.linalg.norm(p - np.clip(p, [0, -H, 0], [0, H, 0]), axis=1)


def points(seed: int) -> np.ndarray:
    p = np.random.default_rng(seed).uniform(-1.2, 1.2, (NUM, 3))
    p[: NUM // 4] *= 0.2
    return p


@pytest.mark.parametrize("name", SHAPES)
@given(seed=hs.integers(0, 10_000))
def test_distance_is_the_one_to_the_nearest_point(x64, name, seed):
    p = points(seed)
    distance, normal = (np.asarray(a) for a in sdf.signed_distance(SHAPES[name], jnp.asarray(p)))
    outside = np.linalg.norm(p - project(name, p), axis=1)
    is_out = outside > 0
    assert is_out.any() and not is_out.all()
    np.testing.assert_allclose(distance[is_out], outside[is_out], rtol=1e-12)
    np.testing.assert_allclose(distance[~is_out], -depth(name, p[~is_out]), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose((p - distance[:, None] * normal)[is_out], project(name, p)[is_out], atol=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_normal_is_the_gradient_of_the_distance(x64, name):
    p = jnp.asarray(points(0))
    gradient = jax.grad(lambda p: jnp.sum(sdf.signed_distance(SHAPES[name], p)[0]))(p)
    np.testing.assert_allclose(sdf.signed_distance(SHAPES[name], p)[1], gradient, atol=1e-12)


@pytest.mark.parametrize("name", ["sphere", "capsule", "box", "cylinder"])
def test_derivatives_of_distance_and_normal(x64, random_like, central_difference, relative_error, name):
    """With respect to points and sizes."""
    args = jax.tree.map(jnp.asarray, (SHAPES[name], points(1)))
    direction = random_like(2, args)
    _, tangent = jax.jvp(sdf.signed_distance, args, direction)
    difference = central_difference(lambda a: sdf.signed_distance(*a), args, direction, 1e-6)
    assert relative_error(tangent, difference) < 1e-8


@pytest.mark.parametrize("name", SHAPES)
def test_everything_is_finite_in_the_middle_and_on_edges(name):
    p = jnp.array([[0.0, 0, 0], [0, 0.2, 0], [0, H, 0], [0, 5, 0], [0.3, 0.5, 0.8], [R, H, 0], [0.3, 0.3, 0.3]])
    value, back = jax.vjp(sdf.signed_distance, jax.tree.map(jnp.asarray, SHAPES[name]), p)
    gradient = back(jax.tree.map(jnp.ones_like, value))
    for leaf in jax.tree.leaves((value, gradient)):
        assert np.isfinite(leaf).all()


def test_something_else_is_refused():
    with pytest.raises(ValueError, match="use Sphere, Capsule"):
        sdf.signed_distance("ball", jnp.zeros((1, 3)))
