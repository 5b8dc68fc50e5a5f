"""Constitutive laws: what any isotropic solid must obey, and derivatives that are exact and always finite."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.mpm import materials
from rewax.physics.mpm.laws import FLUIDS
from rewax.physics.mpm.materials import Elasticity, Material, Plasticity
from rewax.physics.numerics import components as cp

NUM = 32
"""All tests use as many matrices, so that they share compiled operations."""
SOLIDS = [e for e in Elasticity if e not in FLUIDS]
LAWS = [*itertools.product(SOLIDS, Plasticity), *itertools.product(FLUIDS, [Plasticity.NONE])]
E, NU, YIELD, SOUND = 1e4, 0.3, 300.0, 5.0
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
PARAMETERS = {
    "youngs_modulus": E, "poissons_ratio": NU, "density": 1000.0, "yield_stress": YIELD, "friction_angle": 0.5,
    "cohesion": 0.01, "critical_compression": 0.025, "critical_stretch": 0.0075, "hardening": 10.0,
    "speed_of_sound": SOUND, "activation": 0.0,
}  # fmt: skip
USED = {
    Plasticity.NONE: (),
    Plasticity.VON_MISES: ("yield_stress",),
    Plasticity.DRUCKER_PRAGER: ("friction_angle", "cohesion"),
    Plasticity.SNOW: ("critical_compression", "critical_stretch", "hardening"),
}
SPECIAL = [
    [1.0, 1.0, 1.0],
    [1.5, 1.5, 0.7],
    [1.5, 0.7, 0.7],
    [1.2, 1.2, 1.2],
    [1.2, 0.9, 1e-6],
    [1.2, 0.9, 0.0],
    [1.0, 1e-6, 1e-6],
    [1.0, 0.0, 0.0],
    [0.0, 0.0, 0.0],
    [1.3, 1.1, -0.4],
    [1.0, 1.0, -1.0],
    [1.0, 0.5, -0.5],
    [1.0, 1.0 + 1e-9, 1.0 - 1e-9],
    [8.0, 1.0, 0.125],
]


def material(elasticity=Elasticity.HENCKY, plasticity=Plasticity.NONE, dtype=np.float64, **changes) -> Material:
    numbers = PARAMETERS | changes
    arrays = {name: jnp.asarray(value, dtype) for name, value in numbers.items()}
    return Material(elasticity=elasticity, plasticity=plasticity, **arrays)


def random_F(stretched, seed: int, amount: float = 0.3) -> jax.Array:
    """Deformations with log stretches up to ``amount``."""
    logs = np.random.default_rng(seed).uniform(-amount, amount, (NUM, 3))
    return jnp.asarray(stretched(seed, np.exp(logs)))


def respond(m: Material, F: jax.Array) -> tuple[jax.Array, jax.Array]:
    plastic_volume = 0.97 + 0.05 * jnp.abs(F[:, 0, 1]) if m.remembers else None
    response = materials.respond(m, cp.split_matrix(F), plastic_volume=plastic_volume)
    out = (cp.join_matrix(response.F), cp.join_matrix(response.stress))
    return (*out, response.plastic_volume) if m.remembers else out


def respond_back(m: Material, F: jax.Array, cotangent):
    """Value and vector-Jacobian product."""
    value, back = jax.vjp(respond, m, F)
    return value, back(cotangent)


def total_energy(m: Material, F: jax.Array) -> jax.Array:
    return jnp.sum(materials.elastic_energy_density(m, F))


# One program per law and dtype, shared by all tests.
STRESS = jax.jit(materials.kirchhoff_stress)
RESPOND = jax.jit(respond)
RESPOND_BACK = jax.jit(respond_back)
ENERGY = jax.jit(jax.value_and_grad(total_energy, argnums=1))


def deviator_norm(tau) -> np.ndarray:
    tau = np.asarray(tau, np.float64)
    mean = np.trace(tau, axis1=-2, axis2=-1)[:, None, None] / 3.0
    return np.linalg.norm(tau - mean * np.eye(3), axis=(-2, -1))


@pytest.mark.parametrize("elasticity", Elasticity)
@given(seed=hs.integers(0, 10_000), amount=hs.floats(0.01, 1.0))
def test_stress_is_objective_and_isotropic(x64, stretched, rotations, elasticity, seed, amount):
    m, F, Q = material(elasticity), random_F(stretched, seed, amount), rotations(seed + 7, NUM)
    tau = np.asarray(STRESS(m, F))
    scale = np.abs(tau).max()
    np.testing.assert_allclose(STRESS(m, F @ Q), tau, atol=1e-12 * scale)
    turned = Q @ tau @ np.swapaxes(Q, -1, -2)
    np.testing.assert_allclose(STRESS(m, Q @ F), turned, atol=1e-12 * scale)


@pytest.mark.parametrize("elasticity", Elasticity)
def test_no_stress_and_linear_elasticity_around_rest(x64, elasticity):
    m = material(elasticity)
    rest = jnp.broadcast_to(jnp.eye(3), (NUM, 3, 3))
    np.testing.assert_allclose(STRESS(m, rest), 0.0, atol=1e-9)
    dF = jnp.asarray(np.random.default_rng(0).standard_normal((NUM, 3, 3)))
    _, tangent = jax.jvp(lambda F: materials.kirchhoff_stress(m, F), (rest,), (dF,))
    strain = 0.5 * (dF + jnp.swapaxes(dF, -1, -2))
    mu, lam = {Elasticity.FLUID: (0.0, LAM), Elasticity.TAIT: (0.0, 1000.0 * SOUND**2)}.get(elasticity, (MU, LAM))
    hooke = 2 * mu * strain + lam * jnp.trace(strain, axis1=-2, axis2=-1)[:, None, None] * jnp.eye(3)
    np.testing.assert_allclose(tangent, hooke, rtol=1e-10, atol=1e-9 * E)


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


@pytest.mark.parametrize("elasticity", Elasticity)
@given(seed=hs.integers(0, 10_000))
def test_stress_is_the_derivative_of_the_energy(x64, stretched, elasticity, seed):
    m, F = material(elasticity), random_F(stretched, seed, 0.7)
    _, P = ENERGY(m, F)
    tau = STRESS(m, F)
    np.testing.assert_allclose(P @ jnp.swapaxes(F, -1, -2), tau, atol=1e-11 * np.abs(tau).max())


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


@pytest.mark.parametrize(("elasticity", "plasticity"), LAWS)
def test_derivatives_equal_finite_differences(
    x64, stretched, random_like, central_difference, relative_error, elasticity, plasticity
):
    """Reverse = forward = finite difference, with some particles yielding and some elastic."""
    m, F = material(elasticity, plasticity), random_F(stretched, 3, 0.02)
    m = jax.tree.map(lambda a: jnp.broadcast_to(a, (NUM,)), m)
    F = F.at[: NUM // 2].set(stretched(5, np.broadcast_to([1.2, 1.2, 0.9], (NUM // 2, 3))))
    value, _ = RESPOND_BACK(m, F, jax.tree.map(jnp.ones_like, jax.eval_shape(respond, m, F)))
    yields = np.abs(value[0] - F).max(axis=(1, 2)) > 1e-12
    if plasticity is not Plasticity.NONE:
        assert yields.sum() >= 4 and (~yields).sum() >= 4
    cotangent = random_like(0, value)
    cotangent = (cotangent[0], cotangent[1] / E, *cotangent[2:])
    _, gradient = RESPOND_BACK(m, F, cotangent)
    relative = random_like(1, (m, F))
    sizes = m, jnp.ones_like(F)  # parameters by parts of themselves
    sizes = jax.tree.map(lambda a: 0.1 * a, sizes[0]), sizes[1]
    direction = jax.tree.map(jnp.multiply, relative, sizes)
    _, tangent = jax.jvp(respond, (m, F), direction)
    forward = sum(float(jnp.vdot(c, t)) for c, t in zip(cotangent, tangent, strict=True))
    pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    np.testing.assert_allclose(sum(float(jnp.vdot(g, d)) for g, d in pairs), forward, rtol=1e-10)

    def objective(p) -> float:
        value, _ = RESPOND_BACK(*p, cotangent)
        return sum(float(jnp.vdot(c, v)) for c, v in zip(cotangent, value, strict=True))

    still = jax.tree.map(jnp.zeros_like, direction)
    moves = {"F": (still[0], direction[1])}
    moduli = ("speed_of_sound", "density") if elasticity is Elasticity.TAIT else ("youngs_modulus", "poissons_ratio")
    for leaf in (*moduli, *USED[plasticity]):
        moves[leaf] = (still[0].replace(**{leaf: getattr(direction[0], leaf)}), still[1])
    for leaf, move in moves.items():
        reverse = sum(
            float(jnp.vdot(g, d)) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(move), strict=True)
        )
        assert relative_error(reverse, central_difference(objective, (m, F), move, 1e-6)) < 1e-6, leaf


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("elasticity", "plasticity"), LAWS)
@given(seed=hs.integers(0, 10_000))
def test_values_and_derivatives_are_finite_for_any_deformation(x64, stretched, dtype, elasticity, plasticity, seed):
    rng = np.random.default_rng(seed)
    extremes = rng.choice([1.0, 1.0 + 1e-6, 0.5, 1e-6, 0.0, 2.0], (NUM - len(SPECIAL), 3))
    extremes[:, 2] *= rng.choice([-1.0, 1.0], NUM - len(SPECIAL))
    F = stretched(seed, np.concatenate([SPECIAL, extremes]))
    F[: len(SPECIAL) : 2] = [np.diag(s) for s in SPECIAL[::2]]
    m = jax.tree.map(lambda a: jnp.broadcast_to(a, (NUM,)), material(elasticity, plasticity, dtype))
    F = jnp.asarray(F, dtype)
    value, gradient = RESPOND_BACK(m, F, jax.tree.map(jnp.ones_like, jax.eval_shape(respond, m, F)))
    for leaf in jax.tree.leaves((value, gradient)):
        assert leaf.dtype == dtype
        finite = np.isfinite(leaf).reshape(NUM, -1).all(axis=1)
        assert finite.all(), f"not finite for {F[~finite]}"


def test_sound_speed_and_lame_parameters(x64):
    lame = materials.lame_parameters(2.5, 0.25)
    assert lame.shear == pytest.approx(1.0) and lame.first == pytest.approx(1.0)
    assert float(
        materials.sound_speed(material(youngs_modulus=2.5, poissons_ratio=0.25, density=3.0))
    ) == pytest.approx(1.0)
