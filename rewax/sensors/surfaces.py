"""Surfaces of triangles in a picture: every triangle against every pixel, some triangles at a time."""

import jax
import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.sensors.hits import Hits, Rays
from rewax.sensors.world import NOTHING, Triangles
from rewax.types import Array

_AT_A_TIME = 32


def see_triangles(surface: Triangles, label: int, rays: Rays, *, everything: bool) -> Hits:
    """What rays meet of a surface.

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
    x, y, z = rays.local(surface.vertices)
    corners = jnp.stack([x, y, z], axis=-1)[surface.faces]  # (num_faces, 3, 3)
    num_faces = len(surface.faces)
    chunks = -(-num_faces // _AT_A_TIME)
    padded = jnp.concatenate([corners, jnp.zeros((chunks * _AT_A_TIME - num_faces, 3, 3), corners.dtype)])

    def nearest(best: tuple[Array, Array], chunk: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        triangles, first = chunk
        depth = _depth(triangles, rays)
        which = depth.argmin(axis=0)
        found = jnp.take_along_axis(depth, which[None], axis=0)[0]
        nearer = found < best[0]
        return (jnp.where(nearer, found, best[0]), jnp.where(nearer, first + which, best[1])), None

    pixels = rays.slope[0]
    start = (jnp.full_like(pixels, jnp.inf), jnp.zeros(pixels.shape, jnp.int32))
    firsts = jnp.arange(chunks, dtype=jnp.int32) * _AT_A_TIME
    split = jax.lax.stop_gradient(padded).reshape(chunks, _AT_A_TIME, 3, 3)
    (buffer, winner), _ = jax.lax.scan(nearest, start, (split, firsts))
    if not (everything or rays.gradient):
        return Hits(buffer)
    seen = jnp.isfinite(buffer)
    own = padded[winner]  # (num_pixels, 3, 3)
    depth = jnp.where(seen, _own_depth(own, rays), jnp.inf)
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
    """Depth of every pixel on each triangle, (n, 3, 3) in the camera's frame: shape (n, num_pixels)."""
    a, b, c = (cp.vector(lambda i, k=k: triangles[:, k, i, None]) for k in range(3))
    sides, determinant = _edges(a, b, c, rays.slope)
    return _meet(sides, determinant, rays.near)


def _own_depth(triangles: Array, rays: Rays) -> Array:
    """Depth of each pixel on a triangle of its own, (num_pixels, 3, 3)."""
    a, b, c = (cp.split_vector(triangles[:, k]) for k in range(3))
    sides, determinant = _edges(a, b, c, rays.slope)
    return _meet(sides, determinant, rays.near)


def _normals(triangles: Array, rays: Rays, seen: Array) -> Vec3:
    """Unit normals towards the camera, of triangles in the world, shape (num_pixels, 3, 3)."""
    a, b, c = (cp.split_vector(triangles[:, k]) for k in range(3))
    _, n = cp.unit(cp.cross(cp.subtract(b, a), cp.subtract(c, a)))
    side = jnp.where(cp.dot(n, rays.direction) > 0, -1.0, 1.0)
    return cp.vector(lambda i: jnp.where(seen, side * n[i], 0.0))


__all__ = ["see_triangles"]
