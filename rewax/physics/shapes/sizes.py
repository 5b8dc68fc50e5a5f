"""Legal values of the sizes of shapes."""

import dataclasses
from typing import Any

from rewax.physics.numerics.checks import Number, check_numbers, numbers_of
from rewax.physics.shapes.base import Shape, require_shape


def size_numbers(shape: Any, name: str) -> list[Number]:
    """The sizes of a shape and of its component shapes, with their legal values.

    Args:
      shape: the shape.
      name: its name in messages.

    Raises:
      ValueError: it is no ``Shape``.
    """
    shape = require_shape(shape, name)
    numbers = numbers_of(shape, f"{name}.")
    for field in dataclasses.fields(shape):  # type: ignore[arg-type]
        part = getattr(shape, field.name)
        if isinstance(part, Shape):
            numbers += size_numbers(part, f"{name}.{field.name}")
        elif isinstance(part, (tuple, list)):
            parts = [(i, each) for i, each in enumerate(part) if isinstance(each, Shape)]
            numbers += [n for i, each in parts for n in size_numbers(each, f"{name}.{field.name}[{i}]")]
    return numbers


def check_sizes(name: str, shape: Any) -> None:
    """Raises ValueError for an object that is no ``Shape``, and for illegal sizes: a rule of ``fields``."""
    check_numbers(size_numbers(shape, name))


__all__ = ["check_sizes", "size_numbers"]
