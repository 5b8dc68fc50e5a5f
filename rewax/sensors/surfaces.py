"""Surfaces of triangles in a picture: every triangle against every pixel, some triangles at a time."""

import jax
import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.sensors.hits import Hits, Rays
from rewax.sensors.world import NOTHING, Triangles
from rewax.types import Array

_AT_A_TIME = 8


def see_triangles(surface: Triangles, label: int, rays: Rays, *, everything: bool) -> Hits:
    """First hits of rays with a surface.

    With corners a, b, c in the camera's frame and d a ray's direction, the ray passes the edges on the sides of
    d.(b x c), d.(c x a) and d.(a x b): inside if these have one sign. The ray meets
    the plane at det(a, b, c) over their sum.

    Args:
      surface: triangles, seen from both sides.
      label: its index.
      rays: of a camera.
      everything: labels and normals too.

    Gradient: of depth by vertices, exact on the triangle that is met.
    """
    corners = jnp.stack(rays.local(surface.vertices), axis=-1)[surface.faces]  # (num_faces, 3, 3)
    num_faces, wanted = len(surface.faces), everything or rays.gradient
    chunks = -(-num_faces // _AT_A_TIME)
    padded = jnp.concatenate([corners, jnp.zeros((chunks * _AT_A_TIME - num_faces, 3, 3), corners.dtype)])

    def nearest(
        best: tuple[Array, Array | None], chunk: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array | None], None]:
        # One after the other: a kernel that keeps the picture in cache, where an axis of triangles would fill memory.
        triangles, first = chunk
        depth, winner = best
        for k in range(_AT_A_TIME):
            found = _depth(triangles[k], rays)
            if winner is not None:
                winner = jnp.where(found < depth, first + k, winner)
            depth = jnp.minimum(found, depth)
        return (depth, winner), None

    pixels = rays.slope[0]
    start = (jnp.full_like(pixels, jnp.inf), jnp.zeros(pixels.shape, jnp.int32) if wanted else None)
    firsts = jnp.arange(chunks, dtype=jnp.int32) * _AT_A_TIME
    split = jax.lax.stop_gradient(padded).reshape(chunks, _AT_A_TIME, 3, 3)
    (buffer, winner), _ = jax.lax.scan(nearest, start, (split, firsts))
    if winner is None:
        return Hits(buffer)
    seen = jnp.isfinite(buffer)
    own = padded[winner]  # (num_pixels, 3, 3)
    depth = jnp.where(seen, _depth(own, rays), jnp.inf)
    in_world = surface.vertices[surface.faces[jnp.minimum(winner, num_faces - 1)]]
    return Hits(depth, jnp.where(seen, label, NOTHING), _normals(in_world, rays, seen))


def _edges(a: Vec3, b: Vec3, c: Vec3, slope: tuple[Array, Array]) -> tuple[Vec3, Array]:
    """d.(b x c), d.(c x a), d.(a x b) and the determinant of a, b, c."""
    products = (cp.cross(b, c), cp.cross(c, a), cp.cross(a, b))
    u, v = slope
    sides = cp.vector(lambda k: products[k][0] * u + products[k][1] * v + products[k][2])
    return sides, cp.dot(a, products[0])


def _meet(sides: Vec3, determinant: Array, near: float) -> Array:
    total = sides[0] + sides[1] + sides[2]
    one_sided = jnp.minimum(jnp.minimum(sides[0], sides[1]), sides[2]) >= 0
    one_sided |= jnp.maximum(jnp.maximum(sides[0], sides[1]), sides[2]) <= 0
    met = one_sided & (total != 0)
    depth = determinant / jnp.where(met, total, 1.0)
    return jnp.where(met & (depth > near), depth, jnp.inf)


def _depth(triangles: Array, rays: Rays) -> Array:
    """Depth of every pixel on a triangle in the camera's frame, (3, 3), or on one of its own, (num_pixels, 3, 3)."""
    a, b, c = (cp.split_vector(triangles[..., k, :]) for k in range(3))
    sides, determinant = _edges(a, b, c, rays.slope)
    return _meet(sides, determinant, rays.near)


def _normals(triangles: Array, rays: Rays, seen: Array) -> Vec3:
    """Unit normals towards the camera, of triangles in the world, shape (num_pixels, 3, 3)."""
    a, b, c = (cp.split_vector(triangles[:, k]) for k in range(3))
    _, n = cp.unit(cp.cross(cp.subtract(b, a), cp.subtract(c, a)))
    side = jnp.where(cp.dot(n, rays.direction) > 0, -1.0, 1.0)
    return cp.vector(lambda i: jnp.where(seen, side * n[i], 0.0))


__all__ = ["see_triangles"]
