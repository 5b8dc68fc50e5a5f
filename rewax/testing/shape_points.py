"""The points at which a shape is checked, and its distances and normals there in float64."""

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.shapes import Shape, bounding_box, signed_distance
from rewax.types import Key

NUM = 1024
_CHUNK = 4096
"""Number of points that are evaluated at once. It is constant, so that each operation is compiled once."""


class Sample:
    """A shape in float64 with points around it.

    Attributes:
      shape: the given shape.
      exact: the same shape in float64.
      lower, upper: corners of the bounding box, or of the region of a shape without bounds [m], shape (3,).
      region: corners of the box in and around which points are drawn [m], shape (3,) each.
      size: longest edge of that box [m].
      random: points in and around the box, and far away [m], shape (num, 3).
      special: centre, axes, corners, middles of edges and faces [m], shape (num, 3).
      surface: points at which the distance is zero [m], shape (num, 3).
    """

    def __init__(self, shape: Shape, key: Key, region: tuple[Sequence[float], Sequence[float]] | None) -> None:
        self.shape, self.name = shape, type(shape).__name__
        self.rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).astype(np.uint32))
        with jax.enable_x64(True):
            self.exact = jax.tree.map(lambda a: jnp.asarray(np.asarray(a), float), shape)
        try:
            box = bounding_box(shape) if shape.is_bounded else region or (np.full(3, -1.0), np.ones(3))
        except ValueError as error:
            raise AssertionError(str(error)) from error
        self.region = tuple(np.asarray(corner, np.float64) for corner in region or box)
        self.lower, self.upper = (np.asarray(corner, np.float64) for corner in box)
        assert np.all(self.upper > self.lower), (
            f"region reaches from {at(self.lower)} to {at(self.upper)}: its upper corner must be above the lower one "
            "along each axis"
        )
        self.size = float(np.max(self.upper - self.lower))
        self.random, self.special = self._random(), self._special()
        self.surface = self._surface()

    def distance(self, points: np.ndarray, shape: Shape | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance (num,) and normal (num, 3), in float64."""
        found = []
        with jax.enable_x64(True):
            for first in range(0, len(points), _CHUNK):
                part = points[first : first + _CHUNK]
                padded = jnp.asarray(np.pad(part, ((0, _CHUNK - len(part)), (0, 0))))
                # Not compiled: two fused copies of one comparison may round differently at edges.
                d, n = signed_distance(self.exact if shape is None else shape, padded)
                found.append((np.asarray(d)[: len(part)], np.asarray(n)[: len(part)]))
        return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))  # type: ignore[return-value]

    @functools.cached_property
    def inside(self) -> tuple[np.ndarray, np.ndarray]:
        """One random point in each of 48^3 cells of the box [m], shape (num, 3), and whether it lies inside, (num,)."""
        n = 48
        cells = np.indices((n, n, n)).reshape(3, -1).T
        points = self.lower + (cells + self.rng.uniform(size=cells.shape)) / n * (self.upper - self.lower)
        return points, self.distance(points)[0] < 0

    def _random(self) -> np.ndarray:
        lower, upper = self.region
        middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        near = middle + half * self.rng.uniform(-1.5, 1.5, (NUM, 3))
        within = middle + half * self.rng.uniform(-0.9, 0.9, (NUM // 2, 3))
        far = self.rng.normal(size=(NUM // 4, 3))
        far = middle + 20.0 * self.size * far / np.linalg.norm(far, axis=1, keepdims=True)
        return np.concatenate([near, within, far])

    def _special(self) -> np.ndarray:
        middle = 0.5 * (self.lower + self.upper)
        choices = [
            [0.0, -0.0, 1e-20, m, low, high, 0.5 * (m + high), high + self.size]
            for m, low, high in zip(middle, self.lower, self.upper, strict=True)
        ]
        return np.array(list(itertools.product(*choices)))

    def _surface(self) -> np.ndarray:
        """Points that are moved onto the surface along the normal: in one step if the distance is exact, else in 20."""
        points = self.random
        for _ in range(1 if self.shape.is_exact else 20):
            d, n = self.distance(points)
            points = points - d[:, None] * n
        on_it = np.abs(self.distance(points)[0]) <= 1e-6 * self.size
        return points[on_it]


def at(point: Any) -> str:
    """A point or a vector in a message."""
    return "(" + ", ".join(f"{x:.4g}" for x in np.asarray(point)) + ")"


__all__ = ["NUM", "Sample", "at"]
