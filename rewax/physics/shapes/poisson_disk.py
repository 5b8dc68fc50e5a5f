"""Maximal Poisson-disk sampling of a solid: random points that keep a distance and leave no gap, in numpy."""

import itertools
from collections.abc import Callable

import numpy as np

NUM_ROUNDS = 6
"""Darts thrown per cell, at each of the two cell sizes."""


def maximal_poisson_disk(
    rng: np.random.Generator,
    distance: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    lower: np.ndarray,
    upper: np.ndarray,
    radius: float,
) -> np.ndarray:
    """Points at least ``radius`` apart, such that each point of the solid has one within two radii.

    Cells with the radius as diagonal hold at most one point each. A cell is done when it lies within the radius of a
    point; the remaining cells are halved once. In a halved cell that rejected a dart, every point has a neighbour
    within 1.5 radii. If all darts of a halved cell missed the solid, one is pulled onto the surface. It moves by at
    most half a radius, hence the bound of two radii.

    Args:
      rng: random number generator.
      distance: signed distance [m] and unit normal of points (n, 3).
      lower, upper: box around the solid [m], shape (3,).
      radius: smallest distance [m].

    Returns:
      Points [m], shape (num_points, 3).
    """
    placed = _Placed(lower, upper, radius)
    cells = placed.cells()
    for level in range(2):
        size = placed.side / 2**level
        if level:
            cells = (cells[:, None] + size * np.array(list(itertools.product((0, 1), repeat=3)))).reshape(-1, 3)
        diagonal = size * np.sqrt(3.0)
        cells = cells[distance(cells + 0.5 * size)[0] <= 0.5 * diagonal]
        was_hit = np.zeros(len(cells), bool)
        for _ in range(NUM_ROUNDS):
            live = ~placed.covers(cells, size)
            cells, was_hit = cells[live], was_hit[live]
            darts = cells + size * rng.random(cells.shape)
            hits = distance(darts)[0] <= 0
            was_hit |= hits
            placed.add(rng, darts[hits])
        if level:
            live = ~(placed.covers(cells, size) | was_hit)
            placed.add(rng, _pull(distance, cells[live] + size * rng.random((live.sum(), 3)), 1e-6 * radius))
    return placed.points()


def _pull(distance, points: np.ndarray, tolerance: float) -> np.ndarray:
    """Move points outside onto the surface; drop points that do not reach it."""
    for _ in range(4):
        d, n = distance(points)
        points = points - (np.maximum(d, 0.0) + np.where(d > 0, 0.5 * tolerance, 0.0))[:, None] * n
    return points[distance(points)[0] <= 0]


class _Placed:
    """Points at least a radius apart, stored by cell; the diagonal of a cell is the radius."""

    REACH = 2
    """Neighbour cells on each side: points within the radius are less than sqrt(3) cells apart along an axis."""

    def __init__(self, lower: np.ndarray, upper: np.ndarray, radius: float) -> None:
        # Shrunk by 1e-9, so that rounding cannot make the diagonal exceed the radius.
        self.side = radius / np.sqrt(3.0) * (1.0 - 1e-9)
        self.radius, self.lower = radius, lower
        self.shape = np.maximum(1, np.ceil((upper - lower) / self.side)).astype(int)
        padded = self.shape + 2 * self.REACH
        self.in_cell = np.full((*padded, 3), np.inf)
        around = np.array(list(itertools.product(range(-self.REACH, self.REACH + 1), repeat=3)))
        away = np.abs(around).max(axis=1)
        strides = np.array([padded[1] * padded[2], padded[2], 1])
        self.strides, self.shells = strides, [around[away == distance] @ strides for distance in range(self.REACH + 1)]

    def cells(self) -> np.ndarray:
        """Lowest corners of all cells [m], shape (num_cells, 3)."""
        return self.lower + self.side * np.indices(self.shape).reshape(3, -1).T

    def points(self) -> np.ndarray:
        return self.in_cell[np.isfinite(self.in_cell[..., 0])]

    def add(self, rng: np.random.Generator, darts: np.ndarray) -> None:
        """Add the darts farther than the radius from all points, in random order."""
        darts = darts[~self._is_near(darts, 0.0)]
        darts = darts[rng.permutation(len(darts))]
        for dart, (i, j, k) in zip(darts, self._index(darts), strict=True):
            size = 2 * self.REACH + 1
            near = self.in_cell[i : i + size, j : j + size, k : k + size]
            offset = near - dart
            if np.min(np.einsum("ijkc,ijkc->ijk", offset, offset)) >= self.radius**2:
                self.in_cell[i + self.REACH, j + self.REACH, k + self.REACH] = dart

    def covers(self, cells: np.ndarray, size: float) -> np.ndarray:
        """Mask of the cells, given by their lowest corners, that lie within the radius of one point."""
        return self._is_near(cells + 0.5 * size, 0.5 * size)

    def _is_near(self, points: np.ndarray, half_size: float) -> np.ndarray:
        """Mask of the cubes around points that lie within the radius of one placed point."""
        placed = self.in_cell.reshape(-1, 3)
        cell = (self._index(points) + self.REACH) @ self.strides
        near = np.zeros(len(points), bool)
        for shell in self.shells:
            (rest,) = np.nonzero(~near)
            square, cells, middle = np.full(len(rest), np.inf), cell[rest], points[rest]
            for step in shell:
                away = np.abs(placed[cells + step] - middle) + half_size
                square = np.minimum(square, np.einsum("nc,nc->n", away, away))
            near[rest] = square < self.radius**2
        return near

    def _index(self, points: np.ndarray) -> np.ndarray:
        index = np.floor((points - self.lower) / self.side).astype(int)
        return np.clip(index, 0, self.shape - 1)


__all__ = ["maximal_poisson_disk"]
