"""Random points that keep a distance from each other and cover a solid, in numpy."""

import itertools
from collections.abc import Callable

import numpy as np

NUM_ROUNDS = 6
"""Darts that each cell gets, at each of the two sizes of cells."""


def maximal_poisson_disk(
    rng: np.random.Generator,
    distance: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    lower: np.ndarray,
    upper: np.ndarray,
    radius: float,
) -> np.ndarray:
    """Points of a solid at least ``radius`` apart, such that each point of it has one within two radii.

    Space is cut into cells whose diagonal is the radius, so that each holds one point at most; those that still need
    one are then halved. A cell is done when it is within the radius of a point. A cell of half size in which a dart
    failed has a point within 1.5 radii of all of it. Darts that miss the solid are pulled onto it if a cell has met it
    with none: they move by at most half a radius, which makes it two.

    Args:
      rng: source of random numbers.
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
    """Points outside moved onto the surface; those that do not reach it left out."""
    for _ in range(4):
        d, n = distance(points)
        points = points - (np.maximum(d, 0.0) + np.where(d > 0, 0.5 * tolerance, 0.0))[:, None] * n
    return points[distance(points)[0] <= 0]


class _Placed:
    """Points at least a radius apart, found by the cell they are in; cells have the radius as diagonal."""

    REACH = 2
    """Cells to look at on each side: two points within the radius are less than sqrt(3) cells apart along an axis."""

    def __init__(self, lower: np.ndarray, upper: np.ndarray, radius: float) -> None:
        # A little smaller, so that rounding cannot make the diagonal larger.
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
        """Add darts, in random order, that are not within the radius of a point."""
        darts = darts[~self._is_near(darts, 0.0)]
        darts = darts[rng.permutation(len(darts))]
        for dart, (i, j, k) in zip(darts, self._index(darts), strict=True):
            size = 2 * self.REACH + 1
            near = self.in_cell[i : i + size, j : j + size, k : k + size]
            offset = near - dart
            if np.min(np.einsum("ijkc,ijkc->ijk", offset, offset)) >= self.radius**2:
                self.in_cell[i + self.REACH, j + self.REACH, k + self.REACH] = dart

    def covers(self, cells: np.ndarray, size: float) -> np.ndarray:
        """Which cells, by their lowest corner, lie within the radius of one point."""
        return self._is_near(cells + 0.5 * size, 0.5 * size)

    def _is_near(self, points: np.ndarray, half_size: float) -> np.ndarray:
        """Which cubes around points have all corners within the radius of one placed point."""
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
