"""Elastic constants: numbers known by hand, and the definitions of the moduli that they stand for."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.numerics.elastic_constants import lame_parameters


@pytest.mark.parametrize(
    ("E", "nu", "shear", "first"), [(2.5, 0.25, 1.0, 1.0), (3.0, 0.0, 1.5, 0.0), (1.8, -0.1, 1.0, -1 / 6)]
)
def test_known_numbers(E, nu, shear, first):
    lame = lame_parameters(E, nu)
    assert lame.shear == pytest.approx(shear, rel=1e-14) and lame.first == pytest.approx(first, rel=1e-14)


@given(E=hs.floats(1.0, 1e9), nu=hs.floats(-0.9, 0.49))
def test_a_pulled_bar_and_a_squeezed_block_see_the_given_moduli(E, nu):
    """Uniaxial stress E along a bar strains it by (1, -nu, -nu); pressure changes volume by the bulk modulus."""
    shear, first = lame_parameters(E, nu)
    strain = np.array([1.0, -nu, -nu])
    np.testing.assert_allclose(2 * shear * strain + first * strain.sum(), [E, 0, 0], atol=1e-10 * E)
    assert first + 2 / 3 * shear == pytest.approx(E / (3 * (1 - 2 * nu)), rel=1e-10)


def test_derivatives(x64):
    """By E the moduli themselves over E; by nu at 0.25: -E/2 / (1 + nu)^2 and E (1 + 2 nu^2) / ((1 + nu)(1 - 2 nu))^2."""
    by_E, by_nu = jax.jacobian(lame_parameters, (0, 1))(2.5, 0.25), None
    by_E, by_nu = ([float(d[k]) for d in by_E] for k in (0, 1))
    np.testing.assert_allclose(by_E, [0.4, 0.4], rtol=1e-14)
    np.testing.assert_allclose(by_nu, [-0.8, 2.5 * 1.125 / 0.625**2], rtol=1e-14)
