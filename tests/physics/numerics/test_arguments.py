"""Checks of arguments: each refusal is one sentence with name, value and remedy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax import struct
from rewax.physics.numerics.arguments import check_instance, check_integer, check_plain, check_pytree, real_array


@pytest.mark.parametrize("value", [0, 2.0, True, "3", None, 2**31, jnp.float32(3.0), [3]])
def test_only_integers_in_range_are_taken(value):
    check_integer("n", 3, 1)
    check_integer("n", np.int64(3), 1)
    with pytest.raises(ValueError, match=r"^n is .*: give an integer, at least 1$"):
        check_integer("n", value, 1)


def test_traced_values_are_no_integers():
    def traced(n):
        check_integer("n", n, 1)
        return n

    with pytest.raises(ValueError, match=r"^n is .*: give an integer, at least 1"):
        jax.jit(traced)(3)


def test_other_types_booleans_and_text_are_refused():
    check_instance("name", "a", str, "give a name")
    with pytest.raises(ValueError, match=r"^name is 3: give a name$"):
        check_instance("name", 3, str, "give a name")
    check_plain("x", 3, "give a length")
    for value, what in ((True, ", a boolean"), (2**70, ", which is too large")):
        with pytest.raises(ValueError, match=rf"^x is {value}{what}: give a length$"):
            check_plain("x", value, "give a length")
    assert real_array("x", [1, 2.5], "give numbers").shape == (2,)
    with pytest.raises(ValueError, match=r"^x is 'a', which is no array of real numbers: give numbers$"):
        real_array("x", "a", "give numbers")


def test_a_class_derived_from_a_decorated_one_must_be_decorated_too():
    @struct.dataclass
    class Decorated:
        pass

    class Derived(Decorated):
        pass

    check_pytree("law", Decorated())
    with pytest.raises(
        ValueError, match=r"^law is a Derived, which is no pytree: decorate it with rewax.struct.dataclass$"
    ):
        check_pytree("law", Derived())
