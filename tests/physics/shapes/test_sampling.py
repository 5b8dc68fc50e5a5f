"""Particles in boxes and in shapes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from solids import SHAPES, distance

from rewax.physics import shapes as sdf
from rewax.physics.shapes.sampling import fill, fill_box, sample, sample_box, sample_poisson_disk, volume
from rewax.physics.shapes.volumes import bounding_box

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
    with pytest.raises(ValueError, match=rf"{name}(\[1\])? is .* must be positive"):
        fill_box(CENTER, size, spacing)


# --- Shapes -----------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fill(SHAPES["sphere"], 0.0), "spacing is 0.0, but must be positive"),
        (lambda: fill(SHAPES["sphere"].replace(radius=-0.1), 0.2), r"shape\.radius is -0\.1, but must be positive"),
        (lambda: sample(jax.random.key(0), SHAPES["sphere"], 0), "num is 0: give the number of points"),
        (
            lambda: sample_poisson_disk(jax.random.key(0), SHAPES["sphere"], -1.0),
            "radius is -1.0, but must be positive",
        ),
        (lambda: sample(jax.random.key(0), sdf.Plane(), 3), "shape is a Plane, which has no bounds"),
        (lambda: volume(sdf.Plane()), "shape is a Plane, which has no bounds"),
        (lambda: bounding_box(SHAPES["baked"].replace(values=np.ones((3, 3, 3)))), "nowhere negative"),
        (
            lambda: fill(SHAPES["sphere"], 1e-6),
            r"^spacing is 1e-06 m, which makes about .* points in the box: give a larg",
        ),
        (lambda: fill(SHAPES["box"], 1e-6), "^spacing is 1e-06 m, which makes about "),
        (lambda: fill_box(CENTER, SIZE, 1e-320), "^spacing is 9.99989e-321 m, which makes about inf points in the box"),
        (
            lambda: sample_poisson_disk(jax.random.key(0), SHAPES["sphere"], 1e-6),
            "^radius is 1e-06 m, which makes about .* points in the box: give a larger one, for at most 1e\\+09 points",
        ),
        (lambda: jax.jit(lambda key: sample(key, SHAPES["sphere"], 3))(jax.random.key(0)), "key is traced"),
    ],
)
def test_what_cannot_be_filled_gets_one_sentence(call, message):
    with pytest.raises(ValueError, match=message):
        call()
