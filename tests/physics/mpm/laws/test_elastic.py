"""Elastic laws of solids: formulas of papers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from material_cases import ENERGY, LAM, MU, NU, NUM, SOLIDS, STRESS, E, material

from rewax.physics.mpm import FixedCorotated, Hencky, NeoHookean, materials
from rewax.physics.mpm.laws.base import Stretches
from rewax.physics.numerics.divided_differences import Principal


@pytest.mark.parametrize("elasticity", SOLIDS)
def test_uniaxial_stretch_matches_the_formula(x64, elasticity):
    s = np.linspace(0.5, 2.0, NUM)
    mu, lam = MU, LAM
    F = jnp.asarray(np.stack([np.diag([a, 1.0, 1.0]) for a in s]))
    along, across = {
        Hencky: (2 * mu * np.log(s) + lam * np.log(s), lam * np.log(s)),
        FixedCorotated: (2 * mu * (s - 1) * s + lam * (s - 1) * s, lam * (s - 1) * s),
        NeoHookean: (mu * (s**2 - 1) + lam * np.log(s), lam * np.log(s)),
    }[elasticity]
    tau = STRESS(material(elasticity), F)
    np.testing.assert_allclose(tau[:, 0, 0], along, atol=1e-10 * E)
    np.testing.assert_allclose(tau[:, 1, 1], across, atol=1e-10 * E)
    np.testing.assert_allclose(tau[:, 0, 1], 0.0, atol=1e-10 * E)


def test_inverted_particles_of_the_corotated_solid_are_pushed_back(x64, stretched):
    """Its energy is finite through inversion, and its stress is the energy's derivative there too."""
    s = np.random.default_rng(0).uniform([1.2, 0.8, -0.6], [1.4, 1.1, -0.1], (NUM, 3))
    F, m = jnp.asarray(stretched(0, s)), material(FixedCorotated)
    _, P = ENERGY(m, F)
    tau = STRESS(m, F)
    np.testing.assert_allclose(P @ jnp.swapaxes(F, -1, -2), tau, atol=1e-11 * np.abs(tau).max())
    mu, lam = MU, LAM
    expected = mu * ((s - 1) ** 2).sum(-1) + 0.5 * lam * (s.prod(-1) - 1) ** 2
    np.testing.assert_allclose(materials.elastic_energy_density(m, F), expected, rtol=1e-12)


@pytest.mark.parametrize("elasticity", SOLIDS)
def test_principal_stress_is_stretch_times_the_slope_of_energy(x64, elasticity):
    """tau_i = s_i dpsi/ds_i."""
    law, s = elasticity(youngs_modulus=E, poissons_ratio=NU), jnp.array([1.3, 0.8, 1.05])

    def energy(s):
        return law.energy(Stretches.of(Principal(tuple(s))))

    stress = law.principal_stress(Stretches.of(Principal(tuple(s))))
    np.testing.assert_allclose(np.stack(stress.values), s * jax.grad(energy)(s), rtol=1e-12)
    assert float(energy(jnp.ones(3))) == pytest.approx(0.0, abs=1e-9)
    assert law.moduli() == pytest.approx((MU, LAM))
