"""Return maps end on the yield surface; sand, snow and dough as in their papers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from material_cases import LAM, MU, NU, NUM, RESPOND, STRESS, YIELD, E, material, random_F

from rewax.physics.mpm import DruckerPrager, FixedCorotated, Hencky, Material, Snow, VonMises
from rewax.physics.mpm.laws import MAX_HARDENING
from rewax.physics.mpm.laws.base import Parameters, plastic_law
from rewax.physics.mpm.materials import is_inverted, respond
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.divided_differences import Principal


def deviator_norm(tau) -> np.ndarray:
    tau = np.asarray(tau, np.float64)
    mean = np.trace(tau, axis1=-2, axis2=-1)[:, None, None] / 3.0
    return np.linalg.norm(tau - mean * np.eye(3), axis=(-2, -1))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(seed=hs.integers(0, 10_000), amount=hs.floats(0.05, 1.5))
def test_return_map_ends_on_the_yield_surface_keeps_volume_and_is_idempotent(x64, stretched, dtype, seed, amount):
    m, F = material(plasticity=VonMises, dtype=dtype), random_F(stretched, seed, amount).astype(dtype)
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
    np.testing.assert_allclose(tau, STRESS(m, new), rtol=eps, atol=E * eps)


def test_return_map_cases_flow_and_do_not(x64, stretched):
    """The property above is about both sides of the yield surface: this one knows which side is which."""
    mu, m = MU, material(plasticity=VonMises)
    # Isochoric log strains (a, -a, 0): deviatoric stress norm 2 mu a sqrt(2).
    at_yield = YIELD / (2 * mu * np.sqrt(2))
    a = at_yield * np.linspace(0.1, 2.1, NUM)
    F = jnp.asarray(np.stack([np.diag(np.exp([b, -b, 0.0])) for b in a]))
    new = np.asarray(RESPOND(m, F)[0])
    np.testing.assert_allclose(np.log(np.diagonal(new, axis1=-2, axis2=-1))[:, 0], np.minimum(a, at_yield), rtol=1e-12)


# --- In principal values ----------------------------------------------------------------------------------------------

ONE = np.ones(())


def plastic(plasticity, s, elasticity=Hencky, memory=()):
    """Stretches and principal stresses after flow of one particle, each as an array of three."""
    eigenvalues = Principal(tuple(jnp.asarray(a**2) for a in s))
    law = elasticity(youngs_modulus=E, poissons_ratio=NU)
    elongation, stress, *_ = plastic_law(eigenvalues, Parameters(law, plasticity, ONE, memory))
    return (1.0 + np.stack(elongation.values)) * np.asarray(s), np.stack(stress.values)


def hencky(s):
    e = np.log(s)
    return 2 * MU * e + LAM * e.sum()


ANGLE = 0.5
SLOPE = np.sqrt(2 / 3) * 2 * np.sin(ANGLE) / (3 - np.sin(ANGLE))


def test_sand_under_pressure_slides_at_its_friction_angle(x64):
    """Klar et al. 2016: the deviator of strain ends at (3 lam + 2 mu) / (2 mu) * -tr(e) * slope, volume is kept."""
    e = np.array([-0.06, 0.01, 0.035])
    trace = e.sum()
    limit = (3 * LAM + 2 * MU) / (2 * MU) * -trace * SLOPE
    deviator = e - trace / 3
    assert np.linalg.norm(deviator) > limit
    new, stress = plastic(DruckerPrager(friction_angle=ANGLE), np.exp(e))
    np.testing.assert_allclose(np.log(new), trace / 3 + deviator * limit / np.linalg.norm(deviator), rtol=1e-12)
    np.testing.assert_allclose(stress, hencky(new), rtol=1e-12)
    # In stresses: shear over pressure is that of a cone through the triaxial test with this angle.
    pressure = -stress.mean()
    shear = np.linalg.norm(stress + pressure)
    assert shear / pressure == pytest.approx(3 * SLOPE, rel=1e-12)


def test_sand_inside_its_cone_is_elastic(x64):
    s = np.exp([-0.021, -0.02, -0.019])
    new, stress = plastic(DruckerPrager(friction_angle=ANGLE), s)
    np.testing.assert_array_equal(new, s)
    np.testing.assert_allclose(stress, hencky(s), rtol=1e-12)


def test_sand_that_is_pulled_apart_goes_to_the_apex(x64):
    """Without cohesion it carries no stress; with it, the stress of that strain along each axis."""
    s = np.exp([0.05, 0.01, -0.02])
    new, stress = plastic(DruckerPrager(friction_angle=ANGLE), s)
    np.testing.assert_allclose(new, 1.0, rtol=1e-14)
    np.testing.assert_allclose(stress, 0.0, atol=1e-10)
    new, stress = plastic(DruckerPrager(friction_angle=ANGLE, cohesion=0.01), s)
    np.testing.assert_allclose(np.log(new), 0.01, rtol=1e-12)
    np.testing.assert_allclose(stress, (2 * MU + 3 * LAM) * 0.01, rtol=1e-12)


def test_fresh_sand_at_rest_does_not_hang_on_a_cohesion_of_zero(x64):
    """At F = I and cohesion 0 the apex itself is reached; a small cohesion changes nothing there."""

    def flowed(cohesion, size=0.0):
        return plastic(DruckerPrager(friction_angle=ANGLE, cohesion=cohesion), np.exp([size] * 3))[0]

    def changed(cohesion):
        law = DruckerPrager(friction_angle=ANGLE, cohesion=cohesion)
        change, _ = law.return_map(
            Principal(tuple(jnp.zeros(3))), FixedCorotated(youngs_modulus=E, poissons_ratio=NU).moduli()
        )
        return jnp.stack(change.values)

    np.testing.assert_array_equal(jax.jacfwd(changed)(0.0), 0.0)
    np.testing.assert_array_equal(jax.jacrev(changed)(0.0), 0.0)
    np.testing.assert_array_equal(flowed(1e-3), 1.0)
    np.testing.assert_allclose(flowed(1e-3, 0.01), np.exp(1e-3), rtol=1e-12)


def snow() -> Snow:
    return Snow(critical_compression=0.025, critical_stretch=0.0075, hardening=10.0)


def test_snow_is_clipped_and_what_flows_changes_its_moduli(x64):
    """Stomakhin et al. 2013: moduli times exp(hardening (1 - J_p)), J_p the volume ratio of all flow."""
    s = np.array([0.9, 1.2, 1.0])
    clipped = np.clip(s, 0.975, 1.0075)
    plastic_volume = 0.99 * s.prod() / clipped.prod()
    harder = np.exp(10.0 * (1 - plastic_volume))
    new, stress = plastic(snow(), s, FixedCorotated, (0.99,))
    np.testing.assert_allclose(new, clipped, rtol=1e-14)
    J = clipped.prod()
    np.testing.assert_allclose(
        stress, harder * (2 * MU * (clipped - 1) * clipped + LAM * (J - 1) * J), rtol=1e-10, atol=1e-8
    )


def test_snow_that_was_inverted_is_reported(x64):
    """After the return map its deformation is legal again: the history variable alone tells."""
    elasticity = FixedCorotated(youngs_modulus=E, poissons_ratio=NU)
    law, after = Material(density=1e3, elasticity=elasticity, plasticity=snow()), jax.jit(respond)
    F = jnp.stack([jnp.eye(3), jnp.diag(jnp.array([1.0, -0.5, 1.01])), 0.9 * jnp.eye(3)])
    response = after(law, cp.split_matrix(F), memory=(jnp.array([1.0, 1.0, 0.9]),))
    new, (once,) = cp.join_matrix(response.F), response.memory
    np.testing.assert_allclose(once, [1.0, 0.0, 0.9 * (0.9 / 0.975) ** 3])
    assert (np.linalg.det(new) > 0).all() and np.isfinite(response.stress).all()
    assert after(law, cp.split_matrix(F), memory=(once,)).memory[0][1] == 0.0, "a second inversion hides nothing"
    np.testing.assert_array_equal(is_inverted(law, new, once[:, None]), [False, True, False])


def test_packed_snow_is_at_most_so_much_harder(x64):
    _, soft = plastic(snow(), [0.99] * 3, FixedCorotated, (1.0,))
    _, hard = plastic(snow(), [0.99] * 3, FixedCorotated, (0.3,))
    np.testing.assert_allclose(hard, MAX_HARDENING * soft, rtol=1e-12)
