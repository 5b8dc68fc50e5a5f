"""Rays through a camera's pixels, and their intersections with the world."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose
from rewax.sensors.world import NOTHING
from rewax.types import Array, Scalar


class Rays(NamedTuple):
    """One ray per pixel, row by row: ``origin + depth * direction``."""

    pose: Pose
    """Pose of the camera in the world, shapes (3,), (3, 3)."""
    origin: Vec3
    """Origin of all rays in the world [m], components of shape ()."""
    direction: Vec3
    """Direction in the world, 1 along the viewing direction, components of shape (num_pixels,)."""
    slope: tuple[Array, Array]
    """x and y of each ray at depth 1 in the camera's frame, shape (num_pixels,) each."""
    height: int
    width: int
    focal_length: Scalar
    focal_range: tuple[float, float]
    """Smallest and largest focal length that the compiled program supports."""
    near: float
    gradient: bool = False
    """Whether depth is differentiable with respect to the camera and the visible bodies."""

    def local(self, points: Array) -> tuple[Array, Array, Array]:
        """x, y and depth of points in the camera's frame [m], for points of shape (..., 3) in the world."""
        offset, axes = points - self.pose.position, self.pose.rotation
        x, y, back = (sum(offset[..., k] * axes[k, i] for k in range(3)) for i in range(3))
        return x, y, -back  # type: ignore[return-value]


class Hits(NamedTuple):
    """First intersection of each ray; arrays over pixels."""

    depth: Array
    """Depth [m], shape (num_pixels,), infinite where a ray hits nothing."""
    label: Array | None = None
    """Index into ``World.names``, int32."""
    normal: Vec3 | None = None
    """Normal of the surface, in the world."""


def nearest(layers: Sequence[Hits], rays: Rays, *, everything: bool) -> Hits:
    """The nearest of several hits. Among equally near ones, the first."""
    x = rays.slope[0]
    best = Hits(jnp.full_like(x, jnp.inf))
    if everything:
        zero = jnp.zeros_like(x)
        best = Hits(best.depth, jnp.full(x.shape, NOTHING, jnp.int32), (zero, zero, zero))
    for hits in layers:
        nearer = hits.depth < best.depth
        label = normal = None
        if everything:
            assert hits.label is not None and best.label is not None
            assert hits.normal is not None and best.normal is not None
            label = jnp.where(nearer, hits.label, best.label)
            x, y, z = (jnp.where(nearer, a, b) for a, b in zip(hits.normal, best.normal, strict=True))
            normal = (x, y, z)
        best = Hits(jnp.minimum(hits.depth, best.depth), label, normal)
    return best
