"""What the sizes of shapes may be."""

from typing import Any

from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE, Number
from rewax.physics.shapes.primitives import (
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    HeightField,
    Plane,
    SampledDistance,
    Shape,
    Sphere,
)

_LENGTH = "give a length in metres"
_LENGTHS = "give an array of three lengths in metres"
_VALUES = "give distances in metres"


def size_numbers(shape: Shape, name: str) -> list[Number]:
    """The sizes of a shape and what they may be.

    Args:
      shape: the shape.
      name: what messages call it.

    Raises:
      ValueError: it is none of the shapes of ``rewax.physics.shapes``, or sizes along x, y, z are not an array.
    """
    match shape:
        case Plane():
            return []
        case Sphere():
            return [Number(f"{name}.radius", shape.radius, POSITIVE, _LENGTH)]
        case Capsule():
            return [
                Number(f"{name}.radius", shape.radius, POSITIVE, _LENGTH),
                Number(f"{name}.half_length", shape.half_length, NOT_NEGATIVE, _LENGTH),
            ]
        case Cylinder() | Cone():
            return [
                Number(f"{name}.radius", shape.radius, POSITIVE, _LENGTH),
                Number(f"{name}.half_length", shape.half_length, POSITIVE, _LENGTH),
            ]
        case Box():
            return [_array(f"{name}.half_size", shape.half_size)]
        case Ellipsoid():
            return [_array(f"{name}.semi_axes", shape.semi_axes)]
        case SampledDistance():
            numbers = [Number(f"{name}.values", shape.values, FINITE, _VALUES)]
        case HeightField():
            numbers = [Number(f"{name}.heights", shape.heights, FINITE, _VALUES)]
        case _:
            raise ValueError(f"{name} is {shape!r}: give a shape of rewax.physics.shapes")
    return [
        *numbers,
        Number(f"{name}.origin", shape.origin, FINITE, "give a position in metres"),
        Number(f"{name}.spacing", shape.spacing, POSITIVE, _LENGTH),
    ]


def _array(name: str, value: Any) -> Number:
    if isinstance(value, (tuple, list)):
        raise ValueError(f"{name} is {value}: give an array of shape (3,), jnp.asarray({value})")
    return Number(name, value, POSITIVE, _LENGTHS, (3,))


__all__ = ["size_numbers"]
