"""Which body each pixel of a camera shows."""

import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics.arguments import check_instance
from rewax.sensors.camera import Camera
from rewax.sensors.world import World
from rewax.types import Array, Key


@struct.dataclass
class Labels(struct.Replaceable):
    """Masks of the bodies in a camera's picture, without noise.

    Attributes:
      camera: whose pixels are labelled.
      of: names of the bodies, one channel each; None: all that the world has, in the order of ``World.names`` (static).

    Gradient: none.
    """

    camera: Camera
    of: tuple[str, ...] | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        check_instance("camera", self.camera, Camera, "give Camera.look_at(...)")
        if self.of is not None:
            object.__setattr__(self, "of", (self.of,) if isinstance(self.of, str) else tuple(self.of))

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of the labels that ``see`` returns."""
        return 0.0, 1.0

    def see(self, world: World, key: Key) -> Array:
        """1 where a pixel shows the body of the channel, else 0, shape (height, width, number of bodies).

        Args:
          world: what there is to see.
          key: not used.

        Raises:
          ValueError: ``of`` holds a name that nothing in the world has.
        """
        del key
        channels = [world.label(name) for name in (world.names if self.of is None else self.of)]
        label = self.camera.replace(gradient=False).view(world).label
        return (label[..., None] == jnp.asarray(channels, jnp.int32)).astype(self.camera.position.dtype)


__all__ = ["Labels"]
