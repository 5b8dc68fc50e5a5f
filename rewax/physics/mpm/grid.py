"""The background grid: a box of equally spaced nodes."""

import dataclasses
import math
from typing import Any

import numpy as np

from rewax.physics.numerics.checks import FINITE, POSITIVE, static_integer, static_number


@dataclasses.dataclass(frozen=True, kw_only=True)
class Grid:
    """A box of nodes; static (hashable), so that a trace knows its shape.

    Node (i, j, k) lies at ``origin + spacing * (i, j, k)``. Particles can be anywhere between ``lower`` and ``upper``.

    Attributes:
      shape: nodes along x, y, z.
      spacing: distance of neighbouring nodes, the same along all axes [m].
      origin: position of node (0, 0, 0) [m].
    """

    shape: tuple[int, int, int]
    spacing: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        remedy = "give three numbers of nodes, each at least 4"
        shape = _three("Grid.shape", self.shape, remedy)
        try:
            counts = tuple(static_integer("Grid.shape", n, 4, remedy) for n in shape)
        except ValueError:
            raise ValueError(f"Grid.shape is {shape}: {remedy}") from None
        origin = _three("Grid.origin", self.origin, "give the three coordinates of node (0, 0, 0) in metres")
        coordinates = tuple(static_number("Grid.origin", a, FINITE, "give coordinates in metres") for a in origin)
        spacing = static_number("Grid.spacing", self.spacing, POSITIVE, "give a distance in metres")
        for name, value in (("shape", counts), ("origin", coordinates), ("spacing", spacing)):
            object.__setattr__(self, name, value)

    @property
    def num_nodes(self) -> int:
        return math.prod(self.shape)

    @property
    def num_columns(self) -> int:
        """Columns of nodes along z."""
        return self.shape[0] * self.shape[1]

    @property
    def strides(self) -> tuple[int, int, int]:
        """Change of a node's flat index per step along x, y, z."""
        return (self.shape[1] * self.shape[2], self.shape[2], 1)

    @property
    def lower(self) -> tuple[float, float, float]:
        """Smallest coordinates that a particle can have [m]: half a cell above the first node."""
        x, y, z = (o + 0.5 * self.spacing for o in self.origin)
        return (x, y, z)

    @property
    def upper(self) -> tuple[float, float, float]:
        """Largest coordinates that a particle can have [m]: half a cell below the last node."""
        x, y, z = (o + (n - 1.5) * self.spacing for o, n in zip(self.origin, self.shape, strict=True))
        return (x, y, z)

    def axis_nodes(self, axis: int) -> np.ndarray:
        """Coordinate of every node along one axis [m], shape (shape[axis],), float64."""
        return self.origin[axis] + self.spacing * np.arange(self.shape[axis])


def _three(name: str, value: Any, remedy: str) -> tuple:
    if np.shape(value) != (3,):
        raise ValueError(f"{name} is {value!r}: {remedy}")
    return tuple(value)
