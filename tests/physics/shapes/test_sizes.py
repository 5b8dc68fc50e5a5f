"""What sizes of shapes may be."""

import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics.checks import check_numbers
from rewax.physics.shapes import Box, Capsule, Cone, Cylinder, Ellipsoid, HeightField, Plane, SampledDistance, Sphere
from rewax.physics.shapes.sizes import size_numbers

ONES = np.ones(3)
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


def test_what_is_no_shape_or_no_array_is_refused():
    with pytest.raises(ValueError, match=r"^tool is 'ball': give a shape of rewax\.physics\.shapes$"):
        size_numbers("ball", "tool")
    with pytest.raises(ValueError, match=r"^tool\.half_size is \[1, 2, 3\]: give an array of shape \(3,\)"):
        size_numbers(Box(half_size=[1, 2, 3]), "tool")
    with pytest.raises(ValueError, match=r"^tool\.half_size has shape \(2,\): give an array of shape \(3,\)"):
        check_numbers(size_numbers(Box(half_size=np.ones(2)), "tool"))
