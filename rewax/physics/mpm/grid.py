"""The background grid: a box of equally spaced nodes."""

import dataclasses
import math

import numpy as np

from rewax.physics.numerics.checks import FINITE, POSITIVE
from rewax.physics.numerics.fields import check_fields, integer, items, static

_NODES = "give three numbers of nodes, each at least 4"
_ORIGIN = "give the three coordinates of node (0, 0, 0) in metres"
_RULES = {
    "shape": items(integer(4, _NODES), _NODES, length=3),
    "spacing": static(POSITIVE, "give a distance in metres"),
    "origin": items(static(FINITE, _ORIGIN), _ORIGIN, length=3),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Grid:
    """A box of nodes; static (hashable), so that a trace knows its shape.

    Node (i, j, k) lies at ``origin + spacing * (i, j, k)``. Particles can be anywhere between ``lower`` and ``upper``.

    Attributes:
      shape: nodes along x, y, z.
      spacing: distance of neighbouring nodes, the same along all axes [m].
      origin: position of node (0, 0, 0) [m].

    Raises:
      ValueError: fewer than 4 nodes along an axis, a spacing that is not positive, or an origin that is not finite.
    """

    shape: tuple[int, int, int]
    spacing: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_fields(_RULES, vars(self), "Grid.")
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "origin", tuple(float(a) for a in self.origin))
        object.__setattr__(self, "spacing", float(self.spacing))

    @property
    def num_nodes(self) -> int:
        """Number of nodes of the box."""
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
