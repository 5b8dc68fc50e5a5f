"""A cloud of points from a camera's picture, as a robot observes it."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics.numerics.arguments import check_instance
from rewax.sensors.camera import Camera
from rewax.sensors.world import World
from rewax.types import Array, Key


@struct.dataclass
class DepthCloud(struct.Replaceable):
    """A fixed number of points from a camera's picture, in world coordinates.

    Attributes:
      camera: the camera. Its pixels become points, with its noise.
      num_points: number of points in the cloud (static).
      of: names of the bodies in the cloud, as if a robot had segmented its picture; None: all bodies (static).

    ``see`` draws ``num_points`` pixels without replacement from the pixels that show one of the bodies. If there are
    fewer pixels, points repeat. If there are none, all points are at the camera's position.
    """

    camera: Camera
    num_points: int = struct.static_field(default=256)
    of: tuple[str, ...] | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        check_instance("camera", self.camera, Camera, "give Camera.look_at(...)")
        if isinstance(self.num_points, np.integer):
            object.__setattr__(self, "num_points", int(self.num_points))
        if isinstance(self.num_points, bool) or not isinstance(self.num_points, int) or self.num_points < 1:
            raise ValueError(f"num_points of the cloud is {self.num_points!r}: give an integer, at least 1")
        if self.of is not None:
            object.__setattr__(self, "of", (self.of,) if isinstance(self.of, str) else tuple(self.of))

    def see(self, world: World, key: Key) -> Array:
        """Points [m], shape (num_points, 3).

        Args:
          world: the bodies.
          key: draws pixels and the camera's noise.

        Raises:
          ValueError: ``of`` holds a name that nothing in the world has, or more points than pixels are asked for.

        Gradient: none, unless ``camera.gradient`` is set; then exact for the drawn pixels.
        """
        pixels = self.camera.height * self.camera.width
        if self.num_points > pixels:
            raise ValueError(f"num_points is {self.num_points}, but the camera has {pixels} pixels: give at most that")
        noise_key, draw_key = jax.random.split(key)
        if self.of is None:
            depth, label = self.camera.depth(world), None
        else:
            depth, label, _ = self.camera.view(world)
        depth = self.camera.with_noise(depth, noise_key)
        chosen = depth < self.camera.far
        if label is not None:
            chosen &= jnp.isin(label, jnp.asarray([world.label(name) for name in self.of or ()]))
        points = self.camera.points(depth, world).reshape(-1, 3)
        rank = jnp.where(chosen.reshape(-1), jax.random.uniform(draw_key, (pixels,)), -1.0)
        _, order = jax.lax.top_k(rank, self.num_points)
        count = jnp.minimum(chosen.sum(), self.num_points)
        index = order[jnp.arange(self.num_points) % jnp.maximum(count, 1)]
        seen = jnp.where(count > 0, points[index], self.camera.pose_in(world).position)
        return seen if self.camera.gradient else jax.lax.stop_gradient(seen)


__all__ = ["DepthCloud"]
