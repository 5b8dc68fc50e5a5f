"""Bodies filled from a cloud: volume, outline, and even spread of a block and of a heap that is known."""

import jax
import numpy as np
import pytest

import rewax
from rewax.identify import record
from rewax.identify.body import filled, with_body

RNG = np.random.Generator(np.random.PCG64(0))


def heap(count):
    """Seen from above: a cone 0.2 m high with a radius of 0.3 m."""
    radius, angle = 0.3 * np.sqrt(RNG.uniform(size=count)), RNG.uniform(0, 2 * np.pi, count)
    return np.stack([radius * np.cos(angle), 0.2 * (1 - radius / 0.3), radius * np.sin(angle)], -1)


@pytest.mark.parametrize("kind", ["height", "hull"])
def test_a_heap_is_filled_to_its_volume(kind):
    points, volume = filled(heap(2000), 0.0, 1, 500, kind)
    assert volume == pytest.approx(np.pi * 0.3**2 * 0.2 / 3.0, rel=0.05)
    assert len(points) == 500 and points[:, 1].min() > 0.0
    below = 0.2 * (1 - np.linalg.norm(points[:, [0, 2]], axis=1) / 0.3)
    assert (points[:, 1] < below + 0.01).all()
    assert points[:, 1].mean() == pytest.approx(0.05, abs=0.006)  # a quarter of the height
    distance = np.sqrt(((points[:, None] - points[None]) ** 2).sum(-1)) + np.eye(500)
    assert np.median(distance.min(1)) > 0.3 * (volume / 500) ** (1 / 3)


def test_the_body_of_a_record_is_that_of_its_environment():
    env = rewax.make("RollingFlat", scale="small")
    seen = record(env, np.zeros((2, 3), np.float32), jax.random.key(0), num_points=400)
    body = with_body(env, seen.clouds[0][seen.mask[0]])
    assert body.rest_positions.shape == env.rest_positions.shape
    assert float(body.scene.particle_volume) == pytest.approx(float(env.scene.particle_volume), rel=0.25)
    np.testing.assert_allclose(body.rest_positions.mean(0), env.rest_positions.mean(0), atol=0.02)
    state = jax.jit(body.step)(jax.jit(body.reset)(jax.random.key(1)), np.zeros(3, np.float32))
    assert int(state.status) == 0


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"kind": "ball"}, "kind is 'ball': give one of 'height', 'hull'"),
        ({"cloud": np.zeros((3, 3))}, "the cloud has 3 points: a body needs at least 20"),
        ({"cloud": np.linspace(0, 1, 30)[:, None] * np.ones(3)}, "lie on a line or in a plane"),
        ({"floor": 9.0}, "has room for 0 particles"),
    ],
)
def test_what_cannot_be_filled_is_said(change, sentence):
    env = rewax.make("RollingFlat", scale="small")
    with pytest.raises(ValueError, match=sentence):
        with_body(env, **{"cloud": heap(100), **change})


def test_a_body_of_several_materials_is_refused():
    env = rewax.make("SteerFloat", scale="small")
    env = env.replace(scene=env.scene.replace(particle_volume=1e-6))
    with pytest.raises(ValueError, match="different materials"):
        with_body(env, heap(100))
