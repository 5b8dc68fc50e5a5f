"""A point mass that cameras see as a sphere over a floor."""

import jax.numpy as jnp
import numpy as np
import toys

from rewax import struct
from rewax.envs.sensing import Sensing
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Sphere
from rewax.sensors import Camera, DepthCloud, DepthNoise, Labels, Solid, World, half_space


@struct.dataclass
class Visible(toys.PointMass):
    """A sphere of radius 0.2 m at (x, 0.2, 0) over a floor at y = 0."""

    @property
    def up(self):
        return np.array([0.0, 1.0, 0.0])

    def world(self, physics, up):
        center = jnp.concatenate([physics, jnp.array([0.2, 0.0])])
        ball = Solid(shape=Sphere(radius=0.2), pose=Pose(center, jnp.eye(3)), name="ball")
        return World(solids=(ball, half_space(up, 0.0, "floor")))


def visible(length=5):
    """The point mass with gain 0.5."""
    return Visible(gain=jnp.float32(0.5), length=length)


def front_camera(**options):
    """A camera 3 m in front of the point x = 1, 24 pixels high and 32 wide."""
    fields = {"near": 1.0, "far": 4.0, "height": 24, "width": 32, **options}
    return Camera.look_at((1.0, 0.3, 0.0), eye=(1.0, 0.6, 3.0), **fields)


def sensing(length=5, **options):
    """The point mass with that camera as ``depth``."""
    return Sensing(env=visible(length), sensors={"depth": front_camera(**options)})


def each_kind():
    """A sensor of each kind, by its observation."""
    camera = front_camera()
    noisy = camera.replace(noise=DepthNoise(constant=0.5, dropout=0.1))
    return {
        "depth": camera, "noisy": noisy, "labels": Labels(camera=camera), "cloud": DepthCloud(camera=camera, num_points=8)
    }  # fmt: skip
