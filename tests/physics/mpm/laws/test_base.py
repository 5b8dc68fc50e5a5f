"""What laws share: stretches with the sign of the volume, elongation without rounding, and what is to be written."""

import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.mpm.laws import Elasticity, Fluid, Plasticity, Viscosity
from rewax.physics.mpm.laws.base import MIN_STRETCH, ActiveStress, LogarithmicPlasticity, elongation_of, stretches
from rewax.physics.numerics.divided_differences import Principal

ONE = np.ones(())


def test_stretches_are_roots_and_the_smallest_has_the_sign_of_the_volume(x64):
    eigenvalues = Principal(tuple(jnp.asarray(a) for a in (4.0, 0.25, 2.25)))
    np.testing.assert_allclose(np.stack(stretches(eigenvalues, ONE).values), [2.0, 0.5, 1.5], rtol=1e-15)
    np.testing.assert_allclose(np.stack(stretches(eigenvalues, -ONE).values), [2.0, -0.5, 1.5], rtol=1e-15)
    flat = stretches(Principal((ONE, 0.0 * ONE, ONE)), ONE)
    np.testing.assert_allclose(np.stack(flat.values), [1.0, MIN_STRETCH, 1.0], rtol=1e-12)


def test_elongation_is_new_over_old_minus_one_and_exactly_zero_where_nothing_changes(x64):
    s = Principal(tuple(jnp.asarray(a) for a in (1.1, 0.7, 1e-3)))
    change = Principal(tuple(jnp.asarray(a) for a in (-0.1, 0.05, 0.0)))
    found = np.stack(elongation_of(s, s, change).values)
    np.testing.assert_allclose(found, [np.expm1(-0.1), np.expm1(0.05), 0.0], rtol=1e-13)
    assert found[2] == 0.0
    floor = Principal(tuple(jnp.asarray(a) for a in (1.1, 0.7, 1e-2)))
    np.testing.assert_allclose(np.stack(elongation_of(s, floor).values), [0.0, 0.0, 9.0], rtol=1e-13)


@pytest.mark.parametrize(
    ("kind", "method", "args"),
    [
        (Elasticity, "moduli", 0), (Elasticity, "principal_stress", 1), (Elasticity, "energy", 1),
        (Fluid, "stress", 2), (Fluid, "energy_of_volume", 2), (Plasticity, "flow", 3),
        (LogarithmicPlasticity, "return_map", 2), (Viscosity, "stress", 2), (Viscosity, "dynamic_viscosity", 0),
        (ActiveStress, "stress", 1),
    ],
)  # fmt: skip
def test_a_law_without_a_method_says_which(kind, method, args):
    class Mine(kind):
        pass

    with pytest.raises(NotImplementedError, match=f"Mine.{method}"):
        getattr(Mine(), method)(*[None] * args)
