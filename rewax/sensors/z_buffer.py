"""Particles in a picture: balls in a z-buffer."""

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics import components as cp
from rewax.sensors.hits import Hits, Rays
from rewax.sensors.world import NOTHING, Balls
from rewax.types import Array


def reach(balls: Balls, rays: Rays) -> int:
    """Pixels that a ball's picture can extend beyond its centre's pixel, along either axis.

    A ball of angular radius b at an angle a from the viewing direction ends at tan(a + b). It is largest at the depth
    ``near`` and longest in the picture's corner.
    """
    return max(_reach(balls.radius, rays, focal_length) for focal_length in rays.focal_range)


def _reach(radius: float, rays: Rays, focal_length: float) -> int:
    corner = math.atan(math.hypot(0.5 * rays.height, 0.5 * rays.width) / focal_length)
    angle = math.asin(min(radius * math.cos(corner) / rays.near, 1.0))
    if corner + angle >= 0.5 * math.pi:
        return max(rays.height, rays.width)
    extent = focal_length * (math.tan(corner + angle) - math.tan(corner))
    return min(math.floor(extent + 0.5), max(rays.height, rays.width))


def see_balls(balls: Balls, labels: Mapping[str, int], rays: Rays, *, everything: bool) -> Hits:
    """First hits of rays with balls. Each ball writes its depth to the pixels of a square around its centre.

    Args:
      balls: particles; those whose centre is nearer than ``near`` are not seen.
      labels: by name.
      rays: of a camera.
      everything: labels and normals too.

    Gradient: of depth by centres, exact on the ball that is met.
    """
    x, y, z = rays.local(balls.center)
    ahead = z > rays.near
    far_off = jnp.where(ahead, z, 1.0)
    column = jnp.floor(rays.focal_length * x / far_off + 0.5 * rays.width).astype(jnp.int32)
    row = jnp.floor(0.5 * rays.height - rays.focal_length * y / far_off).astype(jnp.int32)
    side = reach(balls, rays)
    offsets = np.arange(-side, side + 1)
    rows, columns = row[:, None, None] + offsets[:, None], column[:, None, None] + offsets
    inside = (rows >= 0) & (rows < rays.height) & (columns >= 0) & (columns < rays.width) & ahead[:, None, None]
    u = (columns + 0.5 - 0.5 * rays.width) / rays.focal_length
    v = (0.5 * rays.height - rows - 0.5) / rays.focal_length
    depth = _depth((x[:, None, None], y[:, None, None], z[:, None, None]), (u, v), balls.radius)
    num_pixels = rays.height * rays.width
    pixel = jnp.where(inside & (depth > rays.near), rows * rays.width + columns, num_pixels)
    buffer = jnp.full(num_pixels, jnp.inf, depth.dtype).at[pixel].min(jax.lax.stop_gradient(depth), mode="drop")
    if not (everything or rays.gradient):
        return Hits(buffer)
    index = jnp.broadcast_to(jnp.arange(len(balls.center), dtype=jnp.int32)[:, None, None], pixel.shape)
    ties = jnp.where(depth <= buffer[jnp.minimum(pixel, num_pixels - 1)], pixel, num_pixels)
    winner = jnp.full(num_pixels, len(balls.center), jnp.int32).at[ties].min(index, mode="drop")
    seen = jnp.isfinite(buffer)
    center = balls.center[jnp.minimum(winner, len(balls.center) - 1)]
    exact = jnp.where(seen, _depth(rays.local(center), rays.slope, balls.radius), jnp.inf)
    point = cp.vector(lambda i: rays.origin[i] + jnp.where(seen, exact, 0.0) * rays.direction[i])
    outward = cp.subtract(point, cp.split_vector(center))
    names = jnp.asarray(np.repeat([labels[name] for name in balls.names], balls.counts), jnp.int32)
    return Hits(
        depth=exact,
        label=jnp.where(seen, names[jnp.minimum(winner, len(names) - 1)], NOTHING),
        normal=cp.vector(lambda i: jnp.where(seen, outward[i] / balls.radius, 0.0)),
    )


def _depth(center: tuple[Array, Array, Array], slope: tuple[Array, Array], radius: float) -> Array:
    """Depth at which the rays of pixels enter balls, infinite where they miss.

    Args:
      center: x, y and depth in the camera's frame [m], arrays that broadcast against the pixels.
      slope: x and y of pixels at depth 1.
      radius: of the balls [m].
    """
    x, y, z = center
    u, v = slope
    square = u * u + v * v + 1.0
    foot = (u * x + v * y + z) / square  # depth of the ray's point nearest to the centre
    offset = (x - foot * u) ** 2 + (y - foot * v) ** 2 + (z - foot) ** 2
    chord = (radius * radius - offset) / square
    return jnp.where(chord > 0, foot - cp.safe_sqrt(chord), jnp.inf)


__all__ = ["reach", "see_balls"]
