"""The material of tetrahedra: stress is the energy's derivative, small strains are linear elasticity, damping damps."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics import components as cp
from rewax.physics.tets.law import (
    DampingLaw,
    energy_density,
    first_piola_stress,
    small_strain_moduli,
    stable_parameters,
    wave_modulus,
)

MU, LAM = 800.0, 1300.0


def energy(F, activation=0.0):
    return energy_density(cp.split_matrix(F), MU, LAM, activation)


def stress(F, rate=None, damping=0.0, law=DampingLaw.STRAIN_RATE, mu=MU, lam=LAM, activation=0.0):
    rate = None if rate is None else cp.split_matrix(jnp.asarray(rate))
    P = first_piola_stress(
        cp.split_matrix(jnp.asarray(F)), rate, mu=mu, lam=lam, activation=activation, damping=damping, damping_law=law
    )
    return cp.join_matrix(P)


STRESS_AND_SLOPE = jax.jit(
    lambda F, a: (stress(F, activation=a), jax.grad(energy)(F, a), jax.jacfwd(stress)(F), jax.jacrev(stress)(F))
)


@hypothesis.given(
    stretches=st.sampled_from([(1, 1, 1), (1.2, 1.2, 0.7), (1, 1, 0), (0, 0, 0), (1, 1, -1), (1.5, 0.4, -0.3)])
    | st.tuples(*[st.floats(-2, 2)] * 3),
    seed=st.integers(0, 100),
    activation=st.floats(-0.5, 0.5),
)
def test_stress_is_the_derivative_of_energy(x64, rotations, stretches, seed, activation):
    """For any F: at rest, flattened, collapsed to a point and inverted; its own derivatives are finite and agree."""
    u, v = rotations(seed, 2)
    F = jnp.asarray(u @ np.diag(np.asarray(stretches, float)) @ v.T)
    P, slope, forward, reverse = STRESS_AND_SLOPE(F, activation)
    scale = MU + LAM
    np.testing.assert_allclose(P, slope, atol=1e-12 * scale * (1 + np.abs(F).max() ** 4))
    assert np.isfinite(forward).all()
    np.testing.assert_allclose(forward, reverse, atol=1e-9 * scale)
    np.testing.assert_allclose(forward, np.transpose(forward, (2, 3, 0, 1)), atol=1e-9 * scale)  # a Hessian
    # Objectivity: turning the deformed body turns the stress.
    np.testing.assert_allclose(
        stress(u @ F), u @ np.asarray(stress(F)), atol=1e-11 * scale * (1 + np.abs(F).max() ** 4)
    )


def test_at_rest_there_is_neither_stress_nor_energy_and_rotations_change_nothing(x64, rotations):
    for R in (np.eye(3), *rotations(0, 3)):
        np.testing.assert_allclose(stress(R), 0.0, atol=1e-12 * (MU + LAM))
        assert float(energy(jnp.asarray(R))) == pytest.approx(0.0, abs=1e-12 * (MU + LAM))


def test_inverted_tets_are_pushed_back(x64):
    """Stable: the energy grows on the way from rest through flat to inverted."""
    energies = [float(energy(jnp.diag(jnp.array([1.0, 1.0, s])))) for s in np.linspace(1, -1.5, 26)]
    assert np.all(np.diff(energies) > 0)


@pytest.mark.parametrize("nu", [-0.4, 0.0, 0.3, 0.49])
def test_small_strains_see_youngs_modulus_and_poissons_ratio(x64, nu):
    """A bar stretched by e under no lateral stress: stress E e, lateral strain -nu e. Shear: G gamma."""
    E, e = 2e5, 1e-6
    mu, lam = stable_parameters(E, nu)
    P = stress(np.diag([1 + e, 1 - nu * e, 1 - nu * e]), mu=mu, lam=lam)
    np.testing.assert_allclose(P, np.diag([E * e, 0, 0]), atol=1e-4 * E * e)
    sheared = np.eye(3)
    sheared[0, 1] = e
    P = stress(sheared, mu=mu, lam=lam)
    G = E / (2 * (1 + nu))
    np.testing.assert_allclose(P, G * e * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]]), atol=1e-4 * G * e)
    assert small_strain_moduli(mu, lam) == pytest.approx((E, nu), abs=1e-9)
    assert wave_modulus(mu, lam) == pytest.approx(E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)))


def test_the_references_parameters():
    assert small_strain_moduli(1000.0, 1000.0) == pytest.approx((1750.0, 1 / 6))


def test_activation_contracts(x64):
    """At rest it is a tension lam a in all directions; without load the volume goes to where that is balanced."""
    np.testing.assert_allclose(stress(np.eye(3), activation=0.1), 0.1 * LAM * np.eye(3), atol=1e-10)


@pytest.mark.parametrize("law", DampingLaw)
def test_damping_takes_energy_out_and_not_in(x64, rotations, law):
    """Its power P : dF/dt is positive for every motion; the elastic part drops out."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        F, rate = np.eye(3) + 0.5 * rng.standard_normal((3, 3)), rng.standard_normal((3, 3))
        damped = np.asarray(stress(F, rate, 2.0, law)) - np.asarray(stress(F))
        assert np.sum(damped * rate) > 0
    # Growing volume, F = s I: 3 ds/dt of volume and, by either law, ds/dt of each axis at s = 1.
    damped = stress(np.eye(3), 0.5 * np.eye(3), 2.0, law)
    np.testing.assert_allclose(damped, 2.0 * (0.5 + 1.5) * np.eye(3), atol=1e-12)


def test_only_damping_of_strain_rates_leaves_rotation_alone(x64, rotations):
    R, spin = rotations(3, 1)[0], np.array([[0, -1.0, 2.0], [1.0, 0, -3.0], [-2.0, 3.0, 0]])
    F = R @ np.diag([1.2, 0.9, 1.1])
    free = np.asarray(stress(F, spin @ F, 2.0, DampingLaw.STRAIN_RATE)) - np.asarray(stress(F))
    np.testing.assert_allclose(free, 0.0, atol=1e-12)
    braked = np.asarray(stress(F, spin @ F, 2.0, DampingLaw.VELOCITY_GRADIENT)) - np.asarray(stress(F))
    np.testing.assert_allclose(braked, 2.0 * spin @ F, atol=1e-12)


def test_derivatives_of_damped_stress(x64, random_like, central_difference, relative_error):
    """With respect to F, its rate and all parameters."""
    rng = np.random.default_rng(1)
    args = tuple(
        jnp.asarray(a) for a in (rng.standard_normal((3, 3)), rng.standard_normal((3, 3)), 800.0, 1300.0, 0.2, 30.0)
    )

    @jax.jit
    def damped(args):
        F, rate, mu, lam, activation, damping = args
        return stress(F, rate, damping, DampingLaw.STRAIN_RATE, mu, lam, activation)

    move = random_like(2, args)
    tangent = jax.jit(lambda a, m: jax.jvp(damped, (a,), (m,))[1])(args, move)
    assert relative_error(tangent, central_difference(damped, args, move)) < 1e-7
    cotangent = random_like(3, tangent)
    (gradient,) = jax.jit(lambda a, c: jax.vjp(damped, a)[1](c))(args, cotangent)
    reverse = sum(float(jnp.vdot(g, m)) for g, m in zip(gradient, move, strict=True))
    assert reverse == pytest.approx(float(jnp.vdot(cotangent, tangent)), rel=1e-10)
