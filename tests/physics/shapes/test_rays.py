"""Rays: closed forms end on the surface and agree with sphere tracing; rays from inside and from behind miss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.shapes import Box, Capsule, Cone, Cylinder, Ellipsoid, HeightField, Plane, SampledDistance, Sphere
from rewax.physics.shapes.rays import traced_entry

SHAPES = {
    "sphere": Sphere(radius=0.4),
    "box": Box(half_size=(0.3, 0.2, 0.5)),
    "capsule": Capsule(radius=0.2, half_length=0.4),
    "cylinder": Cylinder(radius=0.3, half_length=0.4),
    "cone": Cone(radius=0.4, half_length=0.4),
    "ellipsoid": Ellipsoid(semi_axes=(0.5, 0.2, 0.3)),
}


def rays(count=1000, distance=3.0):
    """Rays from a sphere around the origin to points near it, with directions of any length."""
    generator = np.random.default_rng(0)
    origin = generator.normal(size=(count, 3))
    origin *= distance / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = (generator.uniform(-0.6, 0.6, (count, 3)) - origin) * generator.uniform(0.5, 2.0, (count, 1))
    return tuple(tuple(jnp.asarray(a[:, i], jnp.float32) for i in range(3)) for a in (origin, direction))


def at(origin, direction, t):
    return tuple(o + jnp.where(jnp.isfinite(t), t, 0.0) * d for o, d in zip(origin, direction, strict=True))


@pytest.mark.parametrize("name", SHAPES)
def test_a_ray_ends_on_the_surface_that_faces_it(name):
    shape, (origin, direction) = SHAPES[name], rays()
    t = jax.jit(shape.cast)(origin, direction)
    hit = np.isfinite(t)
    assert 0.2 < hit.mean() < 0.8
    distance, normal = shape.distance(at(origin, direction, t))
    assert np.abs(distance)[hit].max() < 1e-4
    facing = sum(n * d for n, d in zip(normal, direction, strict=True))
    assert (np.asarray(facing)[hit] < 1e-3).mean() > 0.98
    earlier = np.asarray(shape.distance(at(origin, direction, 0.97 * t))[0])[hit]
    assert (earlier > 0).all(), "an earlier point lies inside"


@pytest.mark.parametrize("name", SHAPES)
def test_sphere_tracing_finds_the_same(name):
    shape, (origin, direction) = SHAPES[name], rays()
    exact, traced = (jax.jit(f)(origin, direction) for f in (shape.cast, lambda *ray: traced_entry(shape, *ray)))
    both = np.isfinite(exact) & np.isfinite(traced)
    assert (np.isfinite(exact) == np.isfinite(traced)).mean() > 0.99, "only rays that graze may differ"
    assert np.quantile(np.abs(np.where(both, exact, 0) - np.where(both, traced, 0)), 0.99) < 5e-4


@pytest.mark.parametrize("name", SHAPES)
def test_rays_that_begin_inside_or_point_away_miss(name):
    shape, (origin, direction) = SHAPES[name], rays(50)
    assert not np.isfinite(shape.cast(origin, tuple(-d for d in direction))).any()
    assert not np.isfinite(shape.cast(tuple(0.01 * o for o in origin), direction)).any()
    up, sideways = ((jnp.zeros(1), jnp.ones(1), jnp.zeros(1)), (jnp.ones(1), jnp.zeros(1), jnp.zeros(1)))
    assert np.isinf(shape.cast((jnp.zeros(1),) * 3, up)) and np.isinf(shape.cast((jnp.zeros(1),) * 3, sideways))


def test_a_small_ball_far_away_is_met_to_float32():
    origin = tuple(jnp.full(1, a, jnp.float32) for a in (3.0, 4.0, 0.004))
    t = Sphere(radius=0.01).cast(origin, tuple(jnp.full(1, a, jnp.float32) for a in (-0.6, -0.8, 0.0)))
    np.testing.assert_allclose(t, 5.0 - np.sqrt(0.01**2 - 0.004**2), rtol=5e-7)


def test_planes_height_fields_and_sampled_distances():
    origin, direction = rays(400)
    down = np.asarray(direction[1] < 0) & np.asarray(origin[1] > 0)
    t = np.asarray(Plane().cast(origin, direction))
    assert (np.isfinite(t) == down).all()
    np.testing.assert_allclose((-origin[1] / direction[1])[down], t[down], rtol=1e-5)
    x = np.linspace(-1, 1, 21)
    hills = HeightField(heights=0.1 * np.sin(3 * x)[:, None] + 0 * x, origin=(-1.0, -1.0), spacing=0.1)
    t = hills.cast(origin, direction)
    hit = np.isfinite(t) & (np.asarray(origin[1]) > 1.0)
    assert hit.sum() > 50
    assert np.abs(hills.distance(at(origin, direction, t))[0])[hit].max() < 2e-3
    nodes = np.stack(np.meshgrid(*[np.linspace(-0.6, 0.6, 25)] * 3, indexing="ij"), -1)
    ball = SampledDistance(values=np.linalg.norm(nodes, axis=-1) - 0.4, origin=(-0.6,) * 3, spacing=0.05)
    found, exact = ball.cast(origin, direction), Sphere(radius=0.4).cast(origin, direction)
    both = np.isfinite(found) & np.isfinite(exact)
    assert both.sum() > 100 and (np.isfinite(found) == np.isfinite(exact)).mean() > 0.95
    assert np.quantile(np.abs(np.where(both, found, 0) - np.where(both, exact, 0)), 0.95) < 0.02


def terrain(kind):
    generator, n = np.random.default_rng(1), 9
    heights = {
        "stairs": np.repeat(np.repeat([0.0, 0.5, 1.0], 3)[:, None], 7, axis=1),
        "rough": generator.normal(size=(n, 7)),
        "a ridge": np.where(np.arange(n)[:, None] == 4, 1.0, 0.0) * np.ones(7),
    }[kind]
    return HeightField(heights=heights, origin=(-1.2, -0.9), spacing=0.3)


@pytest.mark.parametrize("kind", ["stairs", "rough", "a ridge"])
def test_rays_meet_steep_terrain_where_they_first_fall_below_it(kind):
    """The distance of a height field is right to first order only: sphere tracing would pass steps and ridges."""
    field, (origin, direction) = terrain(kind), rays(300, distance=2.0)
    shares = np.linspace(0.0, 4.0, 8001)
    steps = jnp.float32(shares)
    along = tuple(o[:, None] + steps * d[:, None] for o, d in zip(origin, direction, strict=True))
    below = np.asarray(field.distance(along)[0]) < 0
    outside = ~below[:, 0]
    first = np.where(below.any(axis=1), shares[below.argmax(axis=1)], np.inf)[outside]
    found = np.asarray(jax.jit(field.cast)(origin, direction))[outside]
    found = np.where(found > shares[-1], np.inf, found)
    assert (np.isfinite(found) == np.isfinite(first)).mean() > 0.99 and np.isfinite(found).sum() > 100
    both = np.isfinite(found) & np.isfinite(first)
    assert np.abs(found - first)[both].max() < 2 * shares[1]


def test_rays_from_below_the_ground_and_from_nowhere_miss():
    field = terrain("stairs")
    below = tuple(map(jnp.float32, ([0.0, np.nan], [-1.0, 0.0], [0.0, 0.0])))
    assert not np.isfinite(field.cast(below, tuple(map(jnp.float32, ([1.0, 1.0], [0.1, 0.1], [0.0, 0.0]))))).any()


def test_rays_that_begin_in_the_box_of_a_sampled_distance_meet_it():
    nodes = np.stack(np.meshgrid(*[np.linspace(-0.6, 0.6, 25)] * 3, indexing="ij"), -1)
    ball = SampledDistance(values=np.linalg.norm(nodes, axis=-1) - 0.2, origin=(-0.6,) * 3, spacing=0.05)
    ray = tuple(map(jnp.float32, (0.5, 0.1, 0.0))), tuple(map(jnp.float32, (-1.0, 0.0, 0.0)))
    np.testing.assert_allclose(ball.cast(*ray), 0.5 - np.sqrt(0.2**2 - 0.1**2), atol=5e-3)


@pytest.mark.parametrize(("tilt", "t"), [(0.0, 1.125), (1e-7, 1.125), (1e-4, 1.12494), (-1e-3, 1.125563)])
def test_rays_nearly_parallel_to_the_slant_of_a_cone(tilt, t):
    """From (-2, 1.5, 0) along (1 + tilt, -2, 0) a ray meets the right slant, x = (1 - y) / 2, or the left one."""
    ray = tuple(map(jnp.float32, (-2.0, 1.5, 0.0))), tuple(map(jnp.float32, (1.0 + tilt, -2.0, 0.0)))
    np.testing.assert_allclose(Cone(radius=1.0, half_length=1.0).cast(*ray), t, rtol=2e-5)
