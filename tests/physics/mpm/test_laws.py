"""Constitutive laws in principal values: formulas of papers, return maps that end on the yield surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from material_cases import ENERGY, LAM, MU, NUM, RESPOND, SOUND, STRESS, YIELD, E, material, random_F

from rewax.physics.mpm import materials
from rewax.physics.mpm.laws import (
    FLUIDS,
    MAX_HARDENING,
    MIN_STRETCH,
    LawParameters,
    elastic_law,
    energy_law,
    fluid_energy,
    fluid_stress,
    plastic_law,
    stretches,
)
from rewax.physics.mpm.materials import Elasticity, Plasticity
from rewax.physics.numerics.divided_differences import Principal
from rewax.physics.numerics.elastic_constants import LameParameters


def deviator_norm(tau) -> np.ndarray:
    tau = np.asarray(tau, np.float64)
    mean = np.trace(tau, axis1=-2, axis2=-1)[:, None, None] / 3.0
    return np.linalg.norm(tau - mean * np.eye(3), axis=(-2, -1))


@pytest.mark.parametrize("elasticity", Elasticity)
def test_uniaxial_stretch_matches_the_formula(x64, elasticity):
    s = np.linspace(0.5, 2.0, NUM)
    mu, lam = MU, LAM
    F = jnp.asarray(np.stack([np.diag([a, 1.0, 1.0]) for a in s]))
    along, across = {
        Elasticity.HENCKY: (2 * mu * np.log(s) + lam * np.log(s), lam * np.log(s)),
        Elasticity.FIXED_COROTATED: (2 * mu * (s - 1) * s + lam * (s - 1) * s, lam * (s - 1) * s),
        Elasticity.NEO_HOOKEAN: (mu * (s**2 - 1) + lam * np.log(s), lam * np.log(s)),
        Elasticity.FLUID: (lam * s * (s - 1),) * 2,
        Elasticity.TAIT: (-s * 1000.0 * SOUND**2 / 7 * (s**-7.0 - 1),) * 2,
    }[elasticity]
    tau = STRESS(material(elasticity), F)
    np.testing.assert_allclose(tau[:, 0, 0], along, atol=1e-10 * E)
    np.testing.assert_allclose(tau[:, 1, 1], across, atol=1e-10 * E)
    np.testing.assert_allclose(tau[:, 0, 1], 0.0, atol=1e-10 * E)


def test_inverted_particles_of_the_corotated_solid_are_pushed_back(x64, stretched):
    """Its energy is finite through inversion, and its stress is the energy's derivative there too."""
    s = np.random.default_rng(0).uniform([1.2, 0.8, -0.6], [1.4, 1.1, -0.1], (NUM, 3))
    F, m = jnp.asarray(stretched(0, s)), material(Elasticity.FIXED_COROTATED)
    _, P = ENERGY(m, F)
    tau = STRESS(m, F)
    np.testing.assert_allclose(P @ jnp.swapaxes(F, -1, -2), tau, atol=1e-11 * np.abs(tau).max())
    mu, lam = MU, LAM
    expected = mu * ((s - 1) ** 2).sum(-1) + 0.5 * lam * (s.prod(-1) - 1) ** 2
    np.testing.assert_allclose(materials.elastic_energy_density(m, F), expected, rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(seed=hs.integers(0, 10_000), amount=hs.floats(0.05, 1.5))
def test_return_map_ends_on_the_yield_surface_keeps_volume_and_is_idempotent(x64, stretched, dtype, seed, amount):
    m, F = material(plasticity=Plasticity.VON_MISES, dtype=dtype), random_F(stretched, seed, amount).astype(dtype)
    eps = 50 * np.finfo(dtype).eps
    before, (new, tau) = deviator_norm(STRESS(m, F)), RESPOND(m, F)
    flows = before > YIELD
    # Strains of order eps carry stresses of order E eps, besides the relative rounding of the stress itself.
    assert np.all(deviator_norm(tau) <= YIELD * (1 + eps) + E * eps)
    np.testing.assert_allclose(deviator_norm(tau)[flows], YIELD, rtol=eps, atol=E * eps)
    np.testing.assert_allclose(np.asarray(new)[~flows], np.asarray(F)[~flows], rtol=eps, atol=eps)
    np.testing.assert_allclose(np.linalg.det(new), np.linalg.det(F), rtol=eps)
    again, _ = RESPOND(m, new)
    np.testing.assert_allclose(again, new, rtol=eps, atol=eps)
    np.testing.assert_allclose(tau, STRESS(m, new), atol=E * eps)


def test_return_map_cases_flow_and_do_not(x64, stretched):
    """The property above is about both sides of the yield surface: this one knows which side is which."""
    mu, m = MU, material(plasticity=Plasticity.VON_MISES)
    # Isochoric log strains (a, -a, 0): deviatoric stress norm 2 mu a sqrt(2).
    at_yield = YIELD / (2 * mu * np.sqrt(2))
    a = at_yield * np.linspace(0.1, 2.1, NUM)
    F = jnp.asarray(np.stack([np.diag(np.exp([b, -b, 0.0])) for b in a]))
    new = np.asarray(RESPOND(m, F)[0])
    np.testing.assert_allclose(np.log(np.diagonal(new, axis1=-2, axis2=-1))[:, 0], np.minimum(a, at_yield), rtol=1e-12)


# --- In principal values ----------------------------------------------------------------------------------------------

LAME = LameParameters(shear=MU, first=LAM)
ONE = np.ones(())


def plastic(plasticity, s, elasticity=Elasticity.HENCKY, **numbers):
    """Stretches and principal stresses after flow of one particle, each as an array of three."""
    eigenvalues = Principal(tuple(jnp.asarray(a**2) for a in s))
    elongation, stress = plastic_law(elasticity, plasticity, eigenvalues, LawParameters(LAME, ONE, **numbers))
    return (1.0 + np.stack(elongation.values)) * np.asarray(s), np.stack(stress.values)


def hencky(s):
    e = np.log(s)
    return 2 * MU * e + LAM * e.sum()


def test_stretches_are_roots_and_the_smallest_has_the_sign_of_the_volume(x64):
    eigenvalues = Principal(tuple(jnp.asarray(a) for a in (4.0, 0.25, 2.25)))
    np.testing.assert_allclose(np.stack(stretches(eigenvalues, ONE).values), [2.0, 0.5, 1.5], rtol=1e-15)
    np.testing.assert_allclose(np.stack(stretches(eigenvalues, -ONE).values), [2.0, -0.5, 1.5], rtol=1e-15)
    flat = stretches(Principal((ONE, 0.0 * ONE, ONE)), ONE)
    np.testing.assert_allclose(np.stack(flat.values), [1.0, MIN_STRETCH, 1.0], rtol=1e-12)


ANGLE = 0.5
SLOPE = np.sqrt(2 / 3) * 2 * np.sin(ANGLE) / (3 - np.sin(ANGLE))


def test_sand_under_pressure_slides_at_its_friction_angle(x64):
    """Klar et al. 2016: the deviator of strain ends at (3 lam + 2 mu) / (2 mu) * -tr(e) * slope, volume is kept."""
    e = np.array([-0.06, 0.01, 0.035])
    trace = e.sum()
    limit = (3 * LAM + 2 * MU) / (2 * MU) * -trace * SLOPE
    deviator = e - trace / 3
    assert np.linalg.norm(deviator) > limit
    new, stress = plastic(Plasticity.DRUCKER_PRAGER, np.exp(e), friction_angle=ANGLE)
    np.testing.assert_allclose(np.log(new), trace / 3 + deviator * limit / np.linalg.norm(deviator), rtol=1e-12)
    np.testing.assert_allclose(stress, hencky(new), rtol=1e-12)
    # In stresses: shear over pressure is that of a cone through the triaxial test with this angle.
    pressure = -stress.mean()
    shear = np.linalg.norm(stress + pressure)
    assert shear / pressure == pytest.approx(3 * SLOPE, rel=1e-12)


def test_sand_inside_its_cone_is_elastic(x64):
    s = np.exp([-0.021, -0.02, -0.019])
    new, stress = plastic(Plasticity.DRUCKER_PRAGER, s, friction_angle=ANGLE)
    np.testing.assert_array_equal(new, s)
    np.testing.assert_allclose(stress, hencky(s), rtol=1e-12)


def test_sand_that_is_pulled_apart_goes_to_the_apex(x64):
    """Without cohesion it carries no stress; with it, the stress of that strain along each axis."""
    s = np.exp([0.05, 0.01, -0.02])
    new, stress = plastic(Plasticity.DRUCKER_PRAGER, s, friction_angle=ANGLE)
    np.testing.assert_allclose(new, 1.0, rtol=1e-14)
    np.testing.assert_allclose(stress, 0.0, atol=1e-10)
    new, stress = plastic(Plasticity.DRUCKER_PRAGER, s, friction_angle=ANGLE, cohesion=0.01)
    np.testing.assert_allclose(np.log(new), 0.01, rtol=1e-12)
    np.testing.assert_allclose(stress, (2 * MU + 3 * LAM) * 0.01, rtol=1e-12)


SNOW = {"critical_compression": 0.025, "critical_stretch": 0.0075, "hardening": 10.0}


def test_snow_is_clipped_and_what_flows_changes_its_moduli(x64):
    """Stomakhin et al. 2013: moduli times exp(hardening (1 - J_p)), J_p the volume ratio of all flow."""
    s = np.array([0.9, 1.2, 1.0])
    clipped = np.clip(s, 0.975, 1.0075)
    plastic_volume = 0.99 * s.prod() / clipped.prod()
    harder = np.exp(10.0 * (1 - plastic_volume))
    new, stress = plastic(Plasticity.SNOW, s, Elasticity.FIXED_COROTATED, plastic_volume=0.99, **SNOW)
    np.testing.assert_allclose(new, clipped, rtol=1e-14)
    J = clipped.prod()
    np.testing.assert_allclose(
        stress, harder * (2 * MU * (clipped - 1) * clipped + LAM * (J - 1) * J), rtol=1e-10, atol=1e-8
    )


def test_packed_snow_is_at_most_so_much_harder(x64):
    _, soft = plastic(Plasticity.SNOW, [0.99] * 3, Elasticity.FIXED_COROTATED, plastic_volume=1.0, **SNOW)
    _, hard = plastic(Plasticity.SNOW, [0.99] * 3, Elasticity.FIXED_COROTATED, plastic_volume=0.3, **SNOW)
    np.testing.assert_allclose(hard, MAX_HARDENING * soft, rtol=1e-12)


@pytest.mark.parametrize("elasticity", [e for e in Elasticity if e not in FLUIDS])
def test_principal_stress_is_stretch_times_the_slope_of_energy(x64, elasticity):
    """tau_i = s_i dpsi/ds_i."""
    s = jnp.array([1.3, 0.8, 1.05])

    def energy(s):
        return energy_law(elasticity, Principal(tuple(s**2)), LawParameters(LAME, ONE))[0].values[0]

    (stress,) = elastic_law(elasticity, Principal(tuple(s**2)), LawParameters(LAME, ONE))
    np.testing.assert_allclose(np.stack(stress.values), s * jax.grad(energy)(s), rtol=1e-12)
    assert float(energy(jnp.ones(3))) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("elasticity", FLUIDS)
def test_fluids_press_with_the_slope_of_their_energy_and_their_bulk_modulus(x64, elasticity):
    """tau = J psi'(J), zero at J = 1; its slope there is the bulk modulus."""
    bulk = 2.5e4
    modulus = LAM if elasticity is Elasticity.FLUID else bulk
    J = jnp.linspace(0.6, 1.4, 9)
    slope = jax.vmap(jax.grad(lambda J: fluid_energy(elasticity, J, LAME, bulk)))(J)
    np.testing.assert_allclose(fluid_stress(elasticity, J, LAME, bulk), J * slope, rtol=1e-11, atol=1e-8)
    at_rest, stiffness = jax.jvp(lambda J: fluid_stress(elasticity, J, LAME, bulk), (ONE,), (ONE,))
    assert float(at_rest) == pytest.approx(0.0, abs=1e-9) and float(stiffness) == pytest.approx(modulus, rel=1e-12)
    assert float(fluid_energy(elasticity, ONE, LAME, bulk)) == pytest.approx(0.0, abs=1e-9)
