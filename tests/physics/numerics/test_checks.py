"""Checks of numbers: both sides of each limit, arrays, and traced values, which pass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics.checks import check_positive, check_range

ALLOWED = [(0.5, (0.0, 1.0)), (np.array([0.1, 0.9]), (0.0, 1.0)), (3, (2.5, np.inf))]
REFUSED = [
    (0.0, (0.0, 1.0)),
    (1.0, (0.0, 1.0)),
    (np.nan, (0.0, 1.0)),
    (None, (0.0, 1.0)),
    (np.array([0.5, 2.0]), (0.0, 1.0)),
    (np.inf, (2.5, np.inf)),
]


@pytest.mark.parametrize(("value", "limits"), ALLOWED)
def test_what_lies_strictly_between_the_limits_passes(value, limits):
    check_range("share", value, limits, "give a share")
    check_range("share", jnp.asarray(value), limits, "give a share")


@pytest.mark.parametrize(("value", "limits"), REFUSED)
def test_anything_else_is_refused_by_name_value_and_remedy(value, limits):
    with pytest.raises(ValueError) as caught:
        check_range("share", value, limits, "give a share")
    assert str(caught.value) == f"share is {value}: give a share"


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, None, np.array([1.0, 0.0])])
def test_what_is_not_positive_is_refused(value):
    with pytest.raises(ValueError) as caught:
        check_positive("mass", value, "give it in kg")
    assert str(caught.value) == f"mass is {value}, but must be positive: give it in kg"
    check_positive("mass", 1e-300, "give it in kg")
    check_positive("mass", np.array([1.0, np.inf]), "give it in kg")


def test_traced_values_pass():
    @jax.jit
    def traced(value):
        check_range("share", value, (0.0, 1.0), "give a share")
        check_positive("mass", value, "give it in kg")
        return value

    assert float(traced(-3.0)) == -3.0
