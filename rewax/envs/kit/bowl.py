"""A round bowl: a shape for tasks that pour."""

import functools

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes import Shape
from rewax.physics.shapes.drawn import Drawing, mesh
from rewax.types import Array, Scalar

_LENGTH = "give a length in metres"
_AROUND = 36
"""Vertices around the drawing."""


@struct.dataclass
class Bowl(Shape):
    """All points within half of ``thickness`` of a hemisphere of ``radius`` below the origin [m].

    It is open above, its rim is round, and the origin is the middle of the rim.
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

    def draw(self) -> list[Drawing]:
        """A mesh; none for traced sizes."""
        if isinstance(self.radius, Tracer) or isinstance(self.thickness, Tracer):
            return []
        return mesh(_surface(float(self.radius), float(self.thickness)))


@functools.lru_cache(maxsize=16)
def _surface(radius: float, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles: the outline of the wall, turned around y."""
    half = 0.5 * thickness
    down, over = np.linspace(-0.5 * np.pi, 0.0, 12), np.linspace(0.0, np.pi, 7)[1:-1]
    wall = np.stack([np.cos(down), np.sin(down)])
    rim = np.stack([radius + half * np.cos(over), half * np.sin(over)])
    r, y = np.concatenate([(radius + half) * wall, rim, (radius - half) * wall[:, ::-1]], axis=1)
    around, rings = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False), len(r)
    vertices = np.stack([r[:, None] * np.cos(around), y[:, None] + 0.0 * around, -r[:, None] * np.sin(around)], axis=-1)
    ring, k = (a.reshape(-1) for a in np.mgrid[: rings - 1, :_AROUND])
    here, beside = ring * _AROUND + k, ring * _AROUND + (k + 1) % _AROUND
    triangles = [(here, beside, beside + _AROUND), (here, beside + _AROUND, here + _AROUND)]
    return vertices.reshape(-1, 3), np.concatenate([np.stack(part, axis=-1) for part in triangles])


__all__ = ["Bowl"]
