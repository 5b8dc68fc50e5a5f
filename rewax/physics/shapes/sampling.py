"""Initial positions of particles in boxes and shapes: a lattice, or random points, or random points a distance apart.

Points of a shape are in the shape's own frame; rotate and shift them with its body. Each point has the volume
``volume(shape) / len(points)``.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE
from rewax.physics.numerics.fields import checked, integer, key, real, static
from rewax.physics.shapes.base import Shape, signed_distance
from rewax.physics.shapes.poisson_disk import maximal_poisson_disk
from rewax.physics.shapes.sizes import check_sizes
from rewax.physics.shapes.volumes import bounding_box, volume
from rewax.types import Array, Key

CHUNK = 8192
"""Number of points in each evaluation of a distance. A constant size needs one compilation per kind of shape."""
MAX_POINTS = 10**9
"""Largest number of points in a box."""


@checked(
    key=key,
    center=real(FINITE, "give a position in metres", shape=(3,)),
    size=real(NOT_NEGATIVE, "give three edges in metres", shape=(3,)),
    num=integer(1, "give the number of points, at least 1"),
)
def sample_box(key: Key, center: Array | Sequence[float], size: Array | Sequence[float], num: int) -> Array:
    """Uniformly random points in a box.

    Args:
      key: PRNG key.
      center: middle of the box [m], shape (3,).
      size: its edges along x, y, z [m], shape (3,).
      num: number of points, each with the volume prod(size) / num.

    Returns:
      Positions [m], shape (num, 3).

    Raises:
      ValueError: a center or size that is not three finite numbers, a size below 0, a num below 1, or no PRNG key.

    Gradient: exact with respect to center and size, which shift and scale the points.

    Example:
      >>> x = sample_box(jax.random.key(0), (0.5, 0.1, 0.5), (0.2, 0.2, 0.2), 1000)
    """
    center, size = jnp.asarray(center), jnp.asarray(size)
    dtype = jnp.result_type(center, size, float)
    unit = jax.random.uniform(key, (num, 3), dtype, -0.5, 0.5)
    return center[None].astype(dtype) + size[None].astype(dtype) * unit


@checked(
    center=real(FINITE, "give a position in metres", shape=(3,)),
    size=real(POSITIVE, "give the three edges of the box in metres", shape=(3,)),
    spacing=static(POSITIVE, "give the distance of neighbours in metres"),
)
def fill_box(center: Sequence[float], size: Sequence[float], spacing: float) -> np.ndarray:
    """Points of a regular lattice that fills a box, symmetric about its centre.

    Each edge is cut into round(edge / spacing) equal intervals (at least one), with a point in the middle of each.
    Every point has the same volume, prod(size) / num_points.

    Args:
      center: middle of the box [m], shape (3,).
      size: its edges along x, y, z [m], shape (3,), > 0.
      spacing: approximate distance of neighbouring points [m], > 0. Half the grid's spacing gives eight particles per
        cell.

    Returns:
      Positions [m], float64 of shape (num_points, 3), z varying fastest.

    Raises:
      ValueError: a spacing or an edge that is not positive, a center that is not finite, or more than ``MAX_POINTS``.

    Gradient: none.

    Example:
      >>> fill_box((0.5, 0.1, 0.5), (0.2, 0.2, 0.2), 0.1).shape
      (8, 3)
    """
    _check_number("spacing", spacing, size)
    counts = [max(1, round(edge / spacing)) for edge in size]
    axes = [
        middle + edge * ((np.arange(n) + 0.5) / n - 0.5) for middle, edge, n in zip(center, size, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@checked(shape=check_sizes, spacing=static(POSITIVE, "give the distance of neighbours in metres"))
def fill(shape: Shape, spacing: float) -> np.ndarray:
    """Points of a cubic lattice that lie in a shape, symmetric about the middle of its bounding box.

    Args:
      shape: a bounded shape. ``fill_box`` fills shapes that fill their bounding box, such as ``Box``.
      spacing: distance of neighbouring points [m], > 0.

    Returns:
      Positions in the shape's frame [m], float64 of shape (num_points, 3), z varying fastest.

    Raises:
      ValueError: a spacing that is not positive, too large for any point or too small (``MAX_POINTS`` in the bounding
        box), or a shape without bounds.

    Gradient: none.

    Example:
      >>> x = fill(Sphere(radius=0.1), 0.02)
      >>> scene = make_scene(particle_volume=volume(Sphere(radius=0.1)) / len(x), ...)  # doctest: +SKIP
    """
    lower, upper = bounding_box(shape)
    if shape.fills_its_box:
        return fill_box(tuple(0.5 * (lower + upper)), tuple(upper - lower), spacing)
    _check_number("spacing", spacing, upper - lower)
    counts = np.maximum(1, np.round((upper - lower) / spacing)).astype(int)
    axes = [m + spacing * (np.arange(n) - 0.5 * (n - 1)) for m, n in zip(0.5 * (lower + upper), counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = points[_distance(shape)(points)[0] < 0]
    if len(points) == 0:
        raise ValueError(f"spacing is {spacing}, but no point of such a lattice lies in the shape: give a smaller one")
    return points


@checked(key=key, shape=check_sizes, num=integer(1, "give the number of points, at least 1"))
def sample(key: Key, shape: Shape, num: int) -> np.ndarray:
    """Uniformly random points in a shape.

    Args:
      key: PRNG key; not traced.
      shape: a bounded shape.
      num: number of points, >= 1, each with the volume volume(shape) / num.

    Returns:
      Positions in the shape's frame [m], float64 of shape (num, 3); the same for the same key.

    Raises:
      ValueError: a num that is not positive, a shape without bounds or volume, a traced key.

    Gradient: none; see ``sample_box`` for boxes.
    """
    rng, distance = _generator(key), _distance(shape)
    lower, upper = bounding_box(shape)
    found, num_found, num_drawn = [], 0, 0
    while num_found < num:
        points = rng.uniform(lower, upper, (CHUNK, 3))
        found.append(points[distance(points)[0] < 0])
        num_found += len(found[-1])
        num_drawn += CHUNK
        if num_found == 0 and num_drawn >= 1000 * CHUNK:
            raise ValueError(
                f"shape fills less than 1e-6 of its bounding box (volume {volume(shape):.3g} m^3): check its sizes"
            )
    return np.concatenate(found)[:num]


@checked(key=key, shape=check_sizes, radius=static(POSITIVE, "give the smallest distance of two points in metres"))
def sample_poisson_disk(key: Key, shape: Shape, radius: float) -> np.ndarray:
    """Random points in a shape, at least a radius apart and without gaps: blue noise.

    Every point of the shape has a sample within two radii (nearly always within 1.1). About 0.72 volume / radius^3
    points fit into a large shape.

    Args:
      key: PRNG key; not traced.
      shape: a bounded shape.
      radius: smallest distance of two points [m], > 0.

    Returns:
      Positions in the shape's frame [m], float64 of shape (num_points, 3); the same for the same key.

    Raises:
      ValueError: a radius that is not positive or too small (``MAX_POINTS`` in the bounding box), a shape without
        bounds, a traced key.

    Gradient: none.
    Source: Ebeida et al. 2012, "A simple algorithm for maximal Poisson-disk sampling in high dimensions". Deviations:
      two levels of cells, and darts outside the shape are pulled onto its surface.
    """
    lower, upper = bounding_box(shape)
    _check_number("radius", radius, upper - lower)
    return maximal_poisson_disk(_generator(key), _distance(shape), lower, upper, radius)


Distance = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@jax.jit
def _signed_distance(shape: Shape, points: Array) -> tuple[Array, Array]:
    return signed_distance(shape, points)


def _distance(shape: Shape) -> Distance:
    """A function that returns signed distances and normals of points (n, 3), for any n, in float64."""
    shape = jax.tree.map(lambda a: np.asarray(a, np.float64), shape)

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distances, normals = [np.zeros(0)], [np.zeros((0, 3))]
        with jax.enable_x64(True), jax.ensure_compile_time_eval():
            for start in range(0, len(points), CHUNK):
                part = points[start : start + CHUNK]
                d, n = _signed_distance(shape, np.pad(part, ((0, CHUNK - len(part)), (0, 0))))
                distances.append(np.asarray(d)[: len(part)])
                normals.append(np.asarray(n)[: len(part)])
        return np.concatenate(distances), np.concatenate(normals)

    return distance


def _check_number(name: str, spacing: float, size: Sequence[float] | np.ndarray) -> None:
    """Raises ValueError if a box holds more than ``MAX_POINTS`` points of this spacing."""
    with np.errstate(over="ignore"):
        number = np.prod(np.maximum(1.0, np.asarray(size, float) / spacing))
    if number > MAX_POINTS:
        raise ValueError(
            f"{name} is {spacing:g} m, which makes about {number:.2g} points in the box: give a larger one, for at "
            f"most {MAX_POINTS:g} points"
        )


def _generator(key: Key) -> np.random.Generator:
    if isinstance(key, Tracer):
        raise ValueError("key is traced: draw these points before jit, or use sample_box, which works under jit")
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).astype(np.uint32))


__all__ = ["fill", "fill_box", "sample", "sample_box", "sample_poisson_disk", "volume"]
