"""Particles in boxes and in shapes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.shapes import primitives as sdf
from rewax.physics.shapes.sampling import fill, fill_box, sample, sample_box, sample_poisson_disk, volume
from rewax.physics.shapes.volume import bounding_box

CENTER, SIZE = (0.5, -0.1, 2.0), (0.2, 0.4, 0.6)


def test_random_points_are_uniform_in_the_box():
    """Mean, variance and correlation of uniform coordinates, each within five standard errors."""
    num = 20_000
    x = np.asarray(sample_box(jax.random.key(0), CENTER, SIZE, num), np.float64)
    unit = (x - CENTER) / SIZE
    assert np.abs(unit).max() <= 0.5 + 1e-6
    np.testing.assert_allclose(unit.mean(0), 0.0, atol=5 / np.sqrt(12 * num))
    np.testing.assert_allclose(np.cov(unit.T), np.eye(3) / 12, atol=5 / (12 * np.sqrt(num)))
    np.testing.assert_array_equal(x, np.asarray(sample_box(jax.random.key(0), CENTER, SIZE, num), np.float64))
    assert np.all(x != np.asarray(sample_box(jax.random.key(1), CENTER, SIZE, num), np.float64))


def test_random_points_move_and_stretch_with_the_box():
    key = jax.random.key(2)

    def mean(center, size):
        return jnp.mean(sample_box(key, center, size, 50), axis=0)

    args = jnp.array(CENTER), jnp.array(SIZE)
    by_center, by_size = jax.jacobian(mean, (0, 1))(*args)
    np.testing.assert_allclose(by_center, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(by_size, np.diag((mean(*args) - args[0]) / args[1]), atol=1e-5)


@given(
    center=hs.tuples(*[hs.floats(-1, 1)] * 3),
    size=hs.tuples(*[hs.floats(0.05, 0.6)] * 3),
    spacing=hs.floats(0.04, 0.3),
)
def test_lattice_is_symmetric_regular_and_fills_the_box(center, size, spacing):
    x = fill_box(center, size, spacing)
    counts = np.maximum(1, np.round(np.array(size) / spacing))
    assert len(x) == np.prod(counts)
    from_center = x - center
    mirrored = -from_center[::-1]
    np.testing.assert_allclose(from_center, mirrored, atol=1e-14)
    for axis in range(3):
        levels = np.unique(np.round(x[:, axis], 12))
        assert len(levels) == counts[axis]
        pitch = size[axis] / counts[axis]
        np.testing.assert_allclose(np.diff(levels), pitch, rtol=1e-9)
        np.testing.assert_allclose(levels[0] - (center[axis] - size[axis] / 2), pitch / 2, atol=1e-11)


@pytest.mark.parametrize(
    ("size", "spacing", "name"), [(SIZE, 0.0, "spacing"), (SIZE, -1.0, "spacing"), ((1, 0, 1), 0.1, "size")]
)
def test_what_is_not_positive_is_refused(size, spacing, name):
    with pytest.raises(ValueError, match=f"{name} is .* must be positive"):
        fill_box(CENTER, size, spacing)


# --- Shapes -----------------------------------------------------------------------------------------------------------

NODES = np.indices((25, 25, 25)) * 0.05 - 0.6
SHAPES = {
    "box": sdf.Box(half_size=np.array([0.2, 0.3, 0.5])),
    "sphere": sdf.Sphere(radius=0.4),
    "cylinder": sdf.Cylinder(radius=0.3, half_length=0.5),
    "baked": sdf.SampledDistance(values=np.linalg.norm(NODES, axis=0) - 0.41, origin=np.full(3, -0.6), spacing=0.05),
}
FURTHER = {
    "capsule": sdf.Capsule(radius=0.3, half_length=0.2),
    "cone": sdf.Cone(radius=0.3, half_length=0.5),
    "ellipsoid": sdf.Ellipsoid(semi_axes=np.array([0.2, 0.3, 0.5])),
}


def distance(shape, points):
    return np.asarray(sdf.signed_distance(shape, jnp.asarray(points))[0])


@pytest.mark.parametrize("name", SHAPES | FURTHER)
def test_volume_and_box_are_those_of_random_points(x64, name):
    """The share of points of the bounding box that lie in the shape, within five standard errors; none beside it."""
    shape = (SHAPES | FURTHER)[name]
    lower, upper = bounding_box(shape)
    points = np.random.default_rng(0).uniform(1.2 * lower, 1.2 * upper, (20_000, 3))
    inside = distance(shape, points) < 0
    assert np.all((points[inside] >= lower) & (points[inside] <= upper))
    whole = np.prod(1.2 * (upper - lower))
    share = float(volume(shape)) / whole
    np.testing.assert_allclose(inside.mean(), share, atol=5 * np.sqrt(share * (1 - share) / len(points)))


@pytest.mark.parametrize("name", SHAPES)
def test_a_lattice_fills_a_shape(x64, name):
    """Symmetric, within, regular; as many points as the volume says, up to the surface's share."""
    shape, spacing = SHAPES[name], 0.04
    x = fill(shape, spacing)
    assert np.all(distance(shape, x) < 0)
    np.testing.assert_allclose(np.sort(x, axis=0), np.sort(-x, axis=0), atol=1e-12)
    for axis in range(3):
        steps = np.diff(np.unique(np.round(x[:, axis], 9)))
        np.testing.assert_allclose(steps, steps[0], rtol=1e-6)
        assert abs(steps[0] / spacing - 1.0) < 0.05
    np.testing.assert_allclose(np.full(len(x), float(volume(shape)) / len(x)).sum(), float(volume(shape)), rtol=1e-12)
    assert abs(len(x) * spacing**3 / float(volume(shape)) - 1.0) < 0.06


@pytest.mark.parametrize("name", SHAPES)
def test_random_points_are_uniform_in_a_shape(x64, name):
    """Within; the centroid and the second moments of a regular filling; the same for the same key."""
    shape, num = SHAPES[name], 4000
    x = sample(jax.random.key(0), shape, num)
    assert x.shape == (num, 3) and np.all(distance(shape, x) < 0)
    regular = fill(shape, 0.02)
    for power in (1, 2):
        moments = regular**power
        error = 5 * moments.std(axis=0) / np.sqrt(num) + 0.01 * (power - 1) * moments.mean(axis=0)
        assert np.all(np.abs((x**power).mean(axis=0) - moments.mean(axis=0)) < error)
    np.testing.assert_array_equal(x, sample(jax.random.key(0), shape, num))
    assert np.all(x != sample(jax.random.key(1), shape, num))


@pytest.mark.parametrize("name", SHAPES | {"cone": FURTHER["cone"]})
def test_poisson_disks_keep_their_distance_and_leave_no_gap(x64, name):
    shape, radius = (SHAPES | FURTHER)[name], 0.08
    x = sample_poisson_disk(jax.random.key(0), shape, radius)
    apart = np.linalg.norm(x[:, None] - x, axis=-1)
    assert apart[~np.eye(len(x), dtype=bool)].min() >= radius
    assert np.all(distance(shape, x) <= 1e-12)
    probes = sample(jax.random.key(1), shape, 4000)
    assert np.linalg.norm(probes[:, None] - x, axis=-1).min(axis=1).max() <= 2 * radius
    assert 0.6 < len(x) * radius**3 / float(volume(shape)) < 1.3  # near 0.72 for large shapes
    np.testing.assert_array_equal(x, sample_poisson_disk(jax.random.key(0), shape, radius))
    other = sample_poisson_disk(jax.random.key(1), shape, radius)
    assert other.shape != x.shape or np.any(other != x)


def test_a_plate_thinner_than_the_radius_is_covered(x64):
    """Where random darts seldom hit, they are pulled onto the shape."""
    plate, radius = sdf.Box(half_size=np.array([0.3, 1e-4, 0.3])), 0.1
    x = sample_poisson_disk(jax.random.key(0), plate, radius)
    probes = sample(jax.random.key(1), plate, 500)
    assert np.linalg.norm(probes[:, None] - x, axis=-1).min(axis=1).max() <= 2 * radius
    assert np.linalg.norm(x[:, None] - x + 9 * np.eye(len(x))[..., None], axis=-1).min() >= radius


def test_volume_of_a_box_whose_faces_hold_nodes_is_exact():
    """Values of zero count neither as inside nor as outside."""
    nodes = jnp.asarray(np.indices((6, 5, 5)).transpose(1, 2, 3, 0) - 2.0)
    values = sdf.signed_distance(sdf.Box(half_size=np.array([2.0, 1.0, 1.0])), nodes - jnp.array([1.0, 0.0, 0.0]))[0]
    assert np.sum(np.asarray(values) == 0) > 20
    baked = sdf.SampledDistance(values=values, origin=jnp.full(3, -2.0), spacing=0.5)
    np.testing.assert_allclose(volume(baked), 16.0 * 0.5**3, rtol=1e-6)


def test_volume_is_differentiable(x64):
    """By the size of a box and by the values of a baked ball."""
    box = jax.grad(lambda h: volume(sdf.Box(half_size=h)))(jnp.array([0.2, 0.3, 0.5]))
    np.testing.assert_allclose(box, 8 * np.array([0.15, 0.1, 0.06]), rtol=1e-12)
    shrunk = jax.grad(lambda d: volume(SHAPES["baked"].replace(values=SHAPES["baked"].values + d)))(0.0)
    np.testing.assert_allclose(shrunk, -4 * np.pi * 0.41**2, rtol=0.02)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fill(SHAPES["sphere"], 0.0), "spacing is 0.0, but must be positive"),
        (lambda: fill(SHAPES["sphere"].replace(radius=-0.1), 0.2), "no point of such a lattice lies in the shape"),
        (lambda: sample(jax.random.key(0), SHAPES["sphere"], 0), "num is 0, but must be positive"),
        (
            lambda: sample_poisson_disk(jax.random.key(0), SHAPES["sphere"], -1.0),
            "radius is -1.0, but must be positive",
        ),
        (lambda: sample(jax.random.key(0), sdf.Plane(), 3), "shape is a Plane, which has no bounds"),
        (lambda: volume(sdf.Plane()), "shape is a Plane, which has no bounds"),
        (lambda: bounding_box(SHAPES["baked"].replace(values=np.ones((3, 3, 3)))), "nowhere negative"),
        (lambda: jax.jit(lambda key: sample(key, SHAPES["sphere"], 3))(jax.random.key(0)), "key is traced"),
    ],
)
def test_what_cannot_be_filled_gets_one_sentence(call, message):
    with pytest.raises(ValueError, match=message):
        call()
