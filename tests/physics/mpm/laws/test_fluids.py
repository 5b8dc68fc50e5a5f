"""Fluids: pressure by volume, slopes of energies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from material_cases import FLUIDS, LAM, NU, NUM, SOUND, STRESS, E, material

from rewax.physics.mpm import QuadraticFluid, Tait

ONE = np.ones(())
QUADRATIC = (QuadraticFluid, {"youngs_modulus": E, "poissons_ratio": NU}, LAM)
TAIT = (Tait, {"speed_of_sound": 5.0}, 1000.0 * 5.0**2)


@pytest.mark.parametrize("fluid", FLUIDS)
def test_stress_of_a_volume_matches_the_formula(x64, fluid):
    J = np.linspace(0.5, 2.0, NUM)
    F = jnp.asarray(np.stack([np.diag([a, 1.0, 1.0]) for a in J]))
    want = LAM * J * (J - 1) if fluid is QuadraticFluid else -J * 1000.0 * SOUND**2 / 7 * (J**-7.0 - 1)
    np.testing.assert_allclose(STRESS(material(fluid), F), want[:, None, None] * np.eye(3), atol=1e-10 * E)


@pytest.mark.parametrize(("kind", "numbers", "modulus"), [QUADRATIC, TAIT])
def test_fluids_press_with_the_slope_of_their_energy_and_their_bulk_modulus(x64, kind, numbers, modulus):
    """tau = J psi'(J), zero at J = 1; its slope there is the bulk modulus, density times speed of sound squared."""
    law, J = kind(**numbers), jnp.linspace(0.6, 1.4, 9)
    slope = jax.vmap(jax.grad(lambda J: law.energy_of_volume(J, 1000.0)))(J)
    np.testing.assert_allclose(law.stress(J, 1000.0), J * slope, rtol=1e-11, atol=1e-8)
    at_rest, stiffness = jax.jvp(lambda J: law.stress(J, 1000.0), (ONE,), (ONE,))
    assert float(at_rest) == pytest.approx(0.0, abs=1e-9) and float(stiffness) == pytest.approx(modulus, rel=1e-12)
    assert float(law.energy_of_volume(ONE, 1000.0)) == pytest.approx(0.0, abs=1e-9)
    assert 1000.0 * float(law.sound_speed(1000.0)) ** 2 == pytest.approx(modulus, rel=1e-6)
