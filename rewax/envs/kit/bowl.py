"""A round bowl: a shape for tasks that pour."""

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes import Shape
from rewax.types import Array, Scalar

_LENGTH = "give a length in metres"


@struct.dataclass
class Bowl(Shape):
    """All points within half of ``thickness`` of a hemisphere of ``radius`` below the origin [m]: open above, round rim.

    The origin is the middle of the rim.
    """

    radius: Scalar = struct.number(POSITIVE, _LENGTH, shape=())
    thickness: Scalar = struct.number(POSITIVE, _LENGTH, shape=())
    has_edges = False

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Exact. At the center of the hemisphere, where all of it is equally near, the normal is zero."""
        x, y, z = p
        below, outwards = cp.unit(p)
        inside = below < self.radius
        # Above the rim, the nearest point of the hemisphere lies on it.
        level, (ux, _, uz) = cp.unit((x, jnp.zeros_like(y), z))
        rim, (away, up, _) = cp.unit((level - self.radius, y, jnp.zeros_like(y)))
        under = y < 0.0
        distance = jnp.where(under, jnp.abs(below - self.radius), rim)
        sign = jnp.where(inside, -1.0, 1.0)
        at_rim = (away * ux, up, away * uz)
        normal = tuple(jnp.where(under, sign * outwards[i], at_rim[i]) for i in cp.AXES)
        return distance - 0.5 * self.thickness, normal  # pyright: ignore[reportReturnType]

    def bounding_box(self) -> tuple[Array, Array]:
        """Exact."""
        radius, half = jnp.asarray(self.radius), 0.5 * jnp.asarray(self.thickness)
        outer = radius + half
        return jnp.stack([-outer, -outer, -outer]), jnp.stack([outer, half, outer])


__all__ = ["Bowl"]
