"""Walls at the sides of the grid's box: boundary conditions on the velocities of grid nodes."""

import enum
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import friction_factor
from rewax.physics.mpm.grid import Grid
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, Number, numbers_of
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.fields import check_fields, instance, items, member, optional, static
from rewax.types import Array, Scalar


class WallKind(enum.Enum):
    """Effect of a wall on the velocities of the nodes beyond it."""

    STICKY = "sticky"
    """Velocity is zero."""
    SLIP = "slip"
    """The component along the normal is zero, in both directions."""
    SEPARATING = "separating"
    """Motion into the wall is stopped, with Coulomb friction; nodes may leave."""
    GRIPPING = "gripping"
    """Nodes that move into the wall stop completely; nodes may leave. This is unlimited Coulomb friction."""


@struct.dataclass
class Wall:
    """A plane normal to a grid axis. It acts on the nodes strictly beyond ``position``.

    Attributes:
      position: coordinate of the wall along its axis [m], between the grid's first and last node (static).
      kind: effect on the node velocities (static).
      friction: Coulomb coefficient of a ``SEPARATING`` wall [-], >= 0; None: none. Gradient: exact.

    Raises:
      ValueError: a position that is not finite or is traced, or no ``WallKind``. ``make_scene`` refuses a wall that
        acts on all nodes or on none, two opposite walls that together act on all nodes (unless both are ``SLIP``, which
        holds the axis alone), and the friction of a wall of another kind.
    """

    position: float = struct.static_field()
    kind: WallKind = struct.static_field(default=WallKind.SEPARATING)
    friction: Scalar | None = struct.number(
        NOT_NEGATIVE, "give a Coulomb coefficient, None for none", shape=(), default=None
    )

    def __post_init__(self) -> None:
        check_fields(_WALL, vars(self), "Wall.")
        object.__setattr__(self, "position", float(self.position))


_WALL = {
    "position": static(FINITE, "give the wall's coordinate in metres"),
    "kind": member(WallKind),
}


@struct.dataclass
class Walls:
    """The six sides of the box; None leaves a side open."""

    lower: tuple[Wall | None, Wall | None, Wall | None]
    upper: tuple[Wall | None, Wall | None, Wall | None]

    def __post_init__(self) -> None:
        check_fields(dict.fromkeys(("lower", "upper"), _SIDE), vars(self), "Walls.")


_SIDE = items(
    optional(instance(Wall, "give a Wall(position=...), or None for an open side")),
    "give three walls along x, y and z, None for an open side",
    length=3,
)


def wall_numbers(walls: Walls) -> list[Number]:
    """The numeric parameters of all walls, with their legal ranges."""
    numbers = []
    for side in ("lower", "upper"):
        for axis, wall in enumerate(getattr(walls, side)):
            if wall is not None:
                numbers += numbers_of(wall, f"walls.{side}[{axis}].")
    return numbers


def check_walls(walls: Walls, grid: Grid) -> None:
    """Raises ValueError for walls that act on all nodes or on none, or whose kind does not use their friction."""
    for side, inward in (("lower", 1.0), ("upper", -1.0)):
        for axis, wall in enumerate(getattr(walls, side)):
            if wall is None:
                continue
            first, last = (float(grid.axis_nodes(axis)[i]) for i in (0, -1))
            behind = _behind(grid, wall, axis, inward, np.arange(grid.shape[axis]))
            if not behind.any() or behind.all():
                raise ValueError(
                    f"walls.{side}[{axis}].position is {wall.position:g} m, but the nodes lie from {first:g} to "
                    f"{last:g} m along this axis and a wall acts on those strictly beyond it, here on "
                    f"{'all' if behind.any() else 'none'}: move the wall between them, or give the grid another origin "
                    "or more nodes"
                )
            if wall.kind is not WallKind.SEPARATING and wall.friction is not None:
                shown = "traced" if isinstance(wall.friction, Tracer) else str(wall.friction)
                raise ValueError(
                    f"walls.{side}[{axis}].friction is {shown}, but a wall of {wall.kind} has none: leave it "
                    "out, or give WallKind.SEPARATING"
                )
    for axis, (lower, upper) in enumerate(zip(walls.lower, walls.upper, strict=True)):
        if lower is None or upper is None or lower.kind is upper.kind is WallKind.SLIP:  # which is plane strain
            continue
        nodes = np.arange(grid.shape[axis])
        if (_behind(grid, lower, axis, 1.0, nodes) | _behind(grid, upper, axis, -1.0, nodes)).all():
            raise ValueError(
                f"walls.lower[{axis}].position is {lower.position:g} m and walls.upper[{axis}].position "
                f"{upper.position:g} m, which together act on all nodes: give a lower wall below the upper one with "
                "nodes between them, or two of WallKind.SLIP to hold the axis alone"
            )


def check_before_walls(walls: Walls, grid: Grid, x: Array) -> None:
    """Raises ValueError for particles at positions x more than a cell behind a wall, whose nodes hold them there."""
    positions = np.asarray(x)
    for side, inward in (("lower", 1.0), ("upper", -1.0)):
        for axis, wall in enumerate(getattr(walls, side)):
            if wall is None:
                continue
            depth = inward * (wall.position - positions[:, axis])
            behind = depth > (1.0 + 1e-6) * grid.spacing
            if behind.any():
                raise ValueError(
                    f"{int(behind.sum())} particles lie up to {depth.max():.3g} m behind walls.{side}[{axis}], which "
                    f"is at {wall.position:g} m and holds them there: move the particles or the wall"
                )


def apply_walls(walls: Walls, grid: Grid, index: tuple[Array, Array, Array], velocity: Vec3) -> Vec3:
    """Apply all walls to node velocities, in the order x, y, z. On each axis, the lower wall comes first.

    Args:
      walls: the six sides.
      grid: the grid.
      index: grid indices of the nodes along x, y, z, int32, each of shape (num_nodes,).
      velocity: node velocities [m/s], components of shape (num_nodes,).

    Gradient: exact with respect to velocities and friction.
    """
    sides = [
        (axis, inward, wall)
        for axis in cp.AXES
        for wall, inward in ((walls.lower[axis], 1.0), (walls.upper[axis], -1.0))
        if wall is not None
    ]
    if not sides:
        return velocity
    behind = [_behind(grid, wall, axis, inward, index[axis]) for axis, inward, wall in sides]
    return _after_walls(walls, behind, velocity)


@recomputed  # a few elementwise operations: XLA fuses them with their neighbours, which is faster than C++
def _after_walls(walls: Walls, behind: list[Array], velocity: Vec3) -> Vec3:
    rest = iter(behind)
    for axis in cp.AXES:
        for wall, inward in ((walls.lower[axis], 1.0), (walls.upper[axis], -1.0)):
            if wall is not None:
                velocity = _apply_wall(wall, axis, inward, next(rest), velocity)
    return velocity


def _behind(grid: Grid, wall: Wall, axis: int, inward: float, index: Any) -> Any:
    """Mask of the nodes strictly beyond the wall, from their indices along its axis.

    Nodes within 1e-6 cells of the wall count as on it.
    """
    cells = (wall.position - grid.origin[axis]) / grid.spacing
    if inward > 0:
        return index < math.ceil(cells - 1e-6)
    return index > math.floor(cells + 1e-6)


def _apply_wall(wall: Wall, axis: int, inward: float, behind: Array, velocity: Vec3) -> Vec3:
    normal_velocity = inward * velocity[axis]
    approaches = behind & (normal_velocity < 0)
    if wall.kind is WallKind.STICKY:
        return cp.vector(lambda i: jnp.where(behind, 0.0, velocity[i]))
    if wall.kind is WallKind.GRIPPING:
        return cp.vector(lambda i: jnp.where(approaches, 0.0, velocity[i]))
    if wall.kind is WallKind.SLIP:
        return cp.vector(lambda i: jnp.where(behind, 0.0, velocity[i]) if i == axis else velocity[i])
    if wall.friction is None:
        return cp.vector(lambda i: jnp.where(approaches, 0.0, velocity[i]) if i == axis else velocity[i])
    zero = jnp.zeros_like(normal_velocity)
    tangential = cp.vector(lambda i: zero if i == axis else velocity[i])
    factor = friction_factor(tangential, jnp.minimum(normal_velocity, 0.0), wall.friction)
    return cp.vector(lambda i: jnp.where(approaches, 0.0 if i == axis else velocity[i] * factor, velocity[i]))
