"""The methods that every solid has, and checks of the form of what they return, when a program is traced."""

from typing import Any, Protocol

from rewax.physics.numerics.checks import shown
from rewax.physics.numerics.components import Vec3
from rewax.types import Array


class Solid(Protocol):
    """The methods of a shape that its defaults need."""

    def distance(self, p: Vec3) -> tuple[Array, Vec3]: ...

    def bounding_box(self) -> tuple[Array, Array]: ...


def distance_to(solid: Solid, p: Vec3) -> tuple[Array, Vec3]:
    """``solid.distance(p)``, checked.

    Raises:
      ValueError: the method returns no distance with the three components of a normal.
    """
    found: Any = solid.distance(p)
    if not _is_tuple(found, 2) or not _is_tuple(found[1], 3):
        raise ValueError(
            f"{type(solid).__name__}.distance returned {shown(found)}: return the signed distance and the normal's "
            "components, as in distance, (x, y, z)"
        )
    return found


def corners_of(solid: Solid) -> tuple[Array, Array]:
    """``solid.bounding_box()``, checked.

    Raises:
      ValueError: the method does not return two corners of three coordinates each.
    """
    found: Any = solid.bounding_box()
    is_array = getattr(found, "shape", ()) == (2, 3)
    if not is_array and not (_is_tuple(found, 2) and all(_has_three(corner) for corner in found)):
        raise ValueError(
            f"{type(solid).__name__}.bounding_box returned {shown(found)}: return the lower and the upper corner in "
            "metres, shape (3,) each"
        )
    return found


def _is_tuple(value: Any, length: int) -> bool:
    return isinstance(value, (tuple, list)) and len(value) == length


def _has_three(corner: Any) -> bool:
    return _is_tuple(corner, 3) or getattr(corner, "shape", ())[-1:] == (3,)


__all__ = ["Solid", "corners_of", "distance_to"]
