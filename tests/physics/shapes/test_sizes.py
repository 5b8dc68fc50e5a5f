"""What sizes of shapes may be."""

import jax.numpy as jnp
import numpy as np
import pytest

from rewax import struct
from rewax.physics.numerics.checks import check_numbers
from rewax.physics.shapes import (
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
from rewax.physics.shapes.sizes import size_numbers

ONES = np.ones(3)


class Bare(Shape):
    """Not decorated."""


@struct.dataclass
class Both(Shape):
    """Made of other shapes."""

    first: Shape
    others: tuple[Shape, ...]


LEGAL = [
    Plane(), Sphere(radius=1.0), Capsule(radius=0.1, half_length=0.0), Cylinder(radius=1.0, half_length=1.0),
    Cone(radius=1.0, half_length=1.0), Box(half_size=ONES), Ellipsoid(semi_axes=jnp.ones(3)),
    SampledDistance(values=-np.ones((2, 2, 2)), origin=np.zeros(3), spacing=0.1),
    HeightField(heights=-np.ones((2, 2)), origin=np.zeros(2), spacing=0.1),
]  # fmt: skip


@pytest.mark.parametrize("shape", LEGAL, ids=lambda s: type(s).__name__)
def test_sizes_of_every_shape_are_checked_one_by_one(shape):
    numbers = size_numbers(shape, "tool")
    check_numbers(numbers)
    assert len(numbers) == len(shape.__dataclass_fields__)
    for number in numbers:
        field = number.name.removeprefix("tool.")
        broken = shape.replace(**{field: np.full(np.shape(number.value), np.nan)})
        with pytest.raises(ValueError, match=rf"^{number.name}.* is nan, but must be"):
            check_numbers(size_numbers(broken, "tool"))


def test_what_is_no_shape_is_refused():
    sentence = "give a shape of rewax.physics.shapes, or of a class derived from Shape"
    with pytest.raises(ValueError, match=f"^tool is 'ball': {sentence}$"):
        size_numbers("ball", "tool")
    with pytest.raises(
        ValueError, match=r"^tool is a Bare, which is no pytree: decorate it with rewax.struct.dataclass$"
    ):
        size_numbers(Bare(), "tool")


def test_three_lengths_are_three():
    assert Box(half_size=(1, 2, 3)).half_size.dtype == jnp.float32
    with pytest.raises(ValueError, match=r"^tool\.half_size has shape \(2,\): give an array of shape \(3,\)"):
        check_numbers(size_numbers(Box(half_size=(1, 2)), "tool"))


def test_parts_of_a_shape_are_checked_too():
    both = Both(first=Sphere(radius=1.0), others=(Plane(), Box(half_size=(1.0, -2.0, 3.0))))
    assert [n.name for n in size_numbers(both, "tool")] == ["tool.first.radius", "tool.others[1].half_size"]
    with pytest.raises(ValueError, match=r"^tool\.others\[1\]\.half_size\[1\] is -2.0, but must be positive"):
        check_numbers(size_numbers(both, "tool"))
