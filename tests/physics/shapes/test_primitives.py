"""Signed distances against projections onto each shape, and normals against the distance's own derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from shape_cases import ALL, HALF, NUM, SAMPLED, SHAPES, TERRAIN, H, R, derivatives, evaluate, points

from rewax.lowering.recompute import recomputed
from rewax.physics import shapes as sdf
from rewax.physics.contact.colliders import Collider, apply_collider
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.pose import Pose


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
    if name == "cone":
        inside = (np.abs(p[:, 1]) <= H) & (radial(p) <= R * (H - p[:, 1]) / (2 * H))
        outline = cone_outline(p)
        nearest = outline[
            np.arange(len(p)), np.argmin(np.linalg.norm(outline - half_plane(p)[:, None], axis=2), axis=1)
        ]
        turned = p * (nearest[:, 0] / radial(p))[:, None]
        turned[:, 1] = nearest[:, 1]
        return np.where(inside[:, None], p, turned)
    on_axis = np.stack([0 * p[:, 0], np.clip(p[:, 1], -H, H), 0 * p[:, 0]], axis=1)
    away = p - on_axis
    return on_axis + away * np.minimum(1.0, R / np.linalg.norm(away, axis=1))[:, None]


def half_plane(p):
    return np.stack([radial(p), p[:, 1]], axis=1)


def cone_outline(p):
    """Nearest points, in the half-plane (r, y), of the base and of the slant, shape (n, 2, 2)."""
    out = []
    for start, end in (([0.0, -H], [R, -H]), ([R, -H], [0.0, H])):
        start, way = np.array(start), np.subtract(end, start)
        out.append(start + np.clip((half_plane(p) - start) @ way / (way @ way), 0, 1)[:, None] * way)
    return np.stack(out, axis=1)


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
    if name == "cone":
        return np.linalg.norm(cone_outline(p) - half_plane(p)[:, None], axis=2).min(axis=1)
    return R - np.linalg.norm(p - np.clip(p, [0, -H, 0], [0, H, 0]), axis=1)


@pytest.mark.parametrize("name", SHAPES)
@given(seed=hs.integers(0, 10_000))
def test_distance_is_the_one_to_the_nearest_point(x64, name, seed):
    p = points(seed)
    distance, normal = (np.asarray(a) for a in evaluate(SHAPES[name], p))
    outside = np.linalg.norm(p - project(name, p), axis=1)
    is_out = outside > 0
    assert is_out.any() and not is_out.all()
    np.testing.assert_allclose(distance[is_out], outside[is_out], rtol=1e-12)
    np.testing.assert_allclose(distance[~is_out], -depth(name, p[~is_out]), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose((p - distance[:, None] * normal)[is_out], project(name, p)[is_out], atol=1e-12)


def inner(a, b) -> float:
    return sum(float(np.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.parametrize("name", ALL)
def test_derivatives_of_distance_and_normal(x64, random_like, central_difference, relative_error, name):
    """With respect to points and sizes, values, heights: reverse = forward = finite difference; normal = gradient."""
    args = jax.tree.map(lambda a: jnp.asarray(a, float), (ALL[name], points(1)))
    tangents = random_like(2, args)
    cotangents = random_like(3, (jnp.zeros(NUM), jnp.zeros((NUM, 3))))
    forward, reverse = derivatives(args, tangents, cotangents)
    assert relative_error(forward, central_difference(lambda a: evaluate(*a), args, tangents)) < 1e-7
    np.testing.assert_allclose(inner(reverse, tangents), inner(cotangents, forward), rtol=1e-11)
    _, normal = evaluate(*args)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
    if name not in ("sampled", "terrain"):
        slope = central_difference(lambda p: evaluate(args[0], p)[0], args[1], tangents[1])
        np.testing.assert_allclose(slope, np.sum(normal * tangents[1], axis=1), atol=1e-8)


SPECIAL = [0.0, -0.0, 1e-20, R, -R, H, -H, 0.3, 0.5, 0.8, -0.8, -0.6, -0.5, -0.7, -0.15, 1.1, 5.0]


@pytest.mark.parametrize("name", ALL)
@given(seed=hs.integers(0, 10_000))
def test_everything_is_finite_in_the_middle_and_on_edges(x64, name, seed):
    """Centres, axes, corners, tips, nodes and borders of grids: values, forward and reverse derivatives."""
    p = np.random.default_rng(seed).choice(SPECIAL, (NUM, 3))
    p[0], p[1] = 0.0, [0.0, H, 0.0]
    args = jax.tree.map(lambda a: jnp.asarray(a, float), (ALL[name], p))
    ones = jnp.ones(NUM, float), jnp.ones((NUM, 3), float)
    for leaf in jax.tree.leaves((evaluate(*args), derivatives(args, jax.tree.map(jnp.ones_like, args), ones))):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("name", ["ellipsoid", "sampled", "terrain"])
def test_nan_stays_where_it_is(x64, name):
    p = points(4)
    expected = evaluate(ALL[name], p)
    p[5] = np.nan
    got = evaluate(ALL[name], p)
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_array_equal(np.delete(a, 5, axis=0), np.delete(b, 5, axis=0))
    assert np.isnan(got[0][5])


@pytest.mark.parametrize("name", ["ellipsoid", "sampled"])
def test_as_a_collider_under_recomputation_and_vmap(x64, random_like, central_difference, name):
    """The gradients of two environments at once, recomputed, against a finite difference."""
    rng = np.random.default_rng(3)
    nodes, velocity = jnp.asarray(points(2)), jnp.asarray(rng.normal(size=(2, NUM, 3)))
    still = Pose(jnp.zeros(3), jnp.eye(3))
    shapes = jax.tree.map(lambda a: jnp.stack([jnp.asarray(a), 1.1 * a]), ALL[name])

    def change(shape, velocity):
        collider = Collider(shape=shape, offset=jnp.zeros(3), rotation=jnp.eye(3), friction=0.4, softness=8.0)
        v = apply_collider(collider, cp.split_vector(nodes), cp.split_vector(velocity), still, still, 1e-3)
        return jnp.sum((cp.join_vector(v) - velocity) ** 2)

    loss = jax.jit(jax.vmap(recomputed(change)))
    args = shapes, velocity
    gradient = jax.jit(jax.grad(lambda *a: jnp.sum(loss(*a)), (0, 1)))(*args)
    for leaf in jax.tree.leaves(gradient[0]):
        assert np.all(np.any(leaf.reshape(2, -1) != 0, axis=1))
    direction = random_like(4, args)
    difference = central_difference(lambda a: loss(*a), args, direction, 1e-7)
    for lane in range(2):
        got = inner(*jax.tree.map(lambda a, i=lane: a[i], (gradient, direction)))
        np.testing.assert_allclose(got, difference[lane], rtol=1e-5)


def test_something_else_is_refused():
    with pytest.raises(
        ValueError, match=r"^shape is .ball.: give a shape of rewax\.physics\.shapes, or of a class derived from Shape$"
    ):
        sdf.signed_distance("ball", jnp.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"SampledDistance.values has shape \(1, 3, 5\): give at least two nodes"):
        sdf.signed_distance(SAMPLED.replace(values=np.zeros((1, 3, 5))), jnp.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"HeightField.heights has shape \(4,\)"):
        sdf.signed_distance(TERRAIN.replace(heights=np.zeros(4)), jnp.zeros((1, 3)))
