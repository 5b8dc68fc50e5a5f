"""Clouds from a camera: only what is seen, a fixed number of points, noise of the camera included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_scenes import CAMERA, FAR, STRAIGHT

from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Box, Sphere
from rewax.sensors import DepthCloud, DepthNoise, Labels, Solid, World


def ball(name: str, at: tuple[float, float, float], radius: float = 0.1) -> Solid:
    return Solid(shape=Sphere(radius=jnp.asarray(radius)), pose=Pose(jnp.asarray(at), STRAIGHT), name=name)


WORLD = World(solids=(ball("dough", (0.0, 0.0, 0.0)), ball("pin", (0.3, 0.0, 0.2))))


def test_points_lie_on_the_side_that_the_camera_sees():
    cloud = DepthCloud(camera=CAMERA, num_points=30, of=("dough",))
    points = jax.jit(cloud.see)(WORLD, jax.random.key(0))
    assert points.shape == (30, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 0.1, atol=1e-5)
    assert (points @ CAMERA.position > 0).all()
    assert len(np.unique(np.asarray(points), axis=0)) == 30, "drawn without replacement"
    both = DepthCloud(camera=CAMERA, num_points=60).see(WORLD, jax.random.key(0))
    assert 0 < (both[:, 0] > 0.15).sum() < 60, "without names all bodies are taken"


def test_points_repeat_where_few_are_seen_and_none_are_the_cameras_place():
    cloud = DepthCloud(camera=CAMERA, num_points=200, of=("dough",))
    points = np.asarray(cloud.see(WORLD.replace(solids=(ball("dough", (0, 0, 0), 0.06),)), jax.random.key(0)))
    different = np.unique(points, axis=0)
    assert 5 < len(different) < 60
    np.testing.assert_allclose(np.linalg.norm(different, axis=-1), 0.06, atol=1e-5)
    wall = Solid(
        shape=Box(half_size=jnp.array([1.0, 0.01, 1.0])), pose=Pose(jnp.array([0.0, -0.5, 0.0]), STRAIGHT), name="pin"
    )
    hidden = cloud.see(WORLD.replace(solids=(ball("dough", (0, 0, 0)), wall)), jax.random.key(0))
    np.testing.assert_array_equal(hidden, np.broadcast_to(CAMERA.position, (200, 3)))


def test_noise_and_dropout_of_the_camera_reach_the_cloud():
    noisy = DepthCloud(camera=CAMERA.replace(noise=DepthNoise(constant=0.01)), num_points=100, of=("dough",))
    points = np.asarray(noisy.see(WORLD, jax.random.key(0)))
    along = (points - np.asarray(CAMERA.position)) @ -np.asarray(CAMERA.rotation)[:, 2]
    assert 0.003 < np.abs(np.linalg.norm(points, axis=-1) - 0.1).std() < 0.012
    assert along.max() < FAR
    blind = DepthCloud(camera=CAMERA.replace(noise=DepthNoise(dropout=1.0)), num_points=10)
    np.testing.assert_array_equal(blind.see(WORLD, jax.random.key(0)), np.broadcast_to(CAMERA.position, (10, 3)))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"num_points": 0}, "num_points of the cloud is 0"), ({"num_points": 10**6}, "has 3072 pixels"), ({"of": ("clay",)}, "of has 'clay'.*dough, pin")],
)  # fmt: skip
def test_bad_clouds_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        DepthCloud(camera=CAMERA, **wrong).see(WORLD, jax.random.key(0))


@pytest.mark.parametrize("sensor", [DepthCloud, Labels])
def test_a_sensor_without_a_camera_is_refused(sensor):
    with pytest.raises(ValueError, match=r"^camera is None: give Camera.look_at\(...\)"):
        sensor(camera=None)


@pytest.mark.parametrize("gradient", [False, True])
def test_a_cloud_of_a_moving_camera_has_the_whole_gradient_or_none(gradient):
    """The camera moves with everything that it sees, so the points move as much."""

    def height(shift):
        camera = CAMERA.replace(position=CAMERA.position + shift * jnp.array([0.0, 1.0, 0.0]), gradient=gradient)
        world = World(solids=(ball("dough", (0.0, shift, 0.0)),))
        return DepthCloud(camera=camera, num_points=30, of=("dough",)).see(world, jax.random.key(0))[:, 1].mean()

    slope = float(jax.grad(height)(0.0))
    assert slope == pytest.approx(1.0 if gradient else 0.0, abs=1e-4)
