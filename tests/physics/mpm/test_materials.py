"""Materials on particles: what any isotropic solid must obey, and derivatives that are exact and always finite."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from material_cases import (
    ENERGY,
    FLUIDS,
    LAM,
    LAWS,
    MU,
    NUM,
    RESPOND_BACK,
    SOLIDS,
    SOUND,
    STRESS,
    E,
    material,
    random_F,
    respond,
)

from rewax.physics.mpm import DruckerPrager, Hencky, Material, QuadraticFluid, Snow, Tait, VonMises, materials
from rewax.physics.numerics.elastic_constants import lame_parameters
from rewax.struct import replace_leaf

HENCKY = Hencky(youngs_modulus=1e4, poissons_ratio=0.3)
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


@pytest.mark.parametrize("elasticity", [*SOLIDS, *FLUIDS])
@given(seed=hs.integers(0, 10_000), amount=hs.floats(0.01, 1.0))
def test_stress_is_objective_and_isotropic(x64, stretched, rotations, elasticity, seed, amount):
    m, F, Q = material(elasticity), random_F(stretched, seed, amount), rotations(seed + 7, NUM)
    tau = np.asarray(STRESS(m, F))
    scale = np.abs(tau).max()
    np.testing.assert_allclose(STRESS(m, F @ Q), tau, atol=1e-12 * scale)
    turned = Q @ tau @ np.swapaxes(Q, -1, -2)
    np.testing.assert_allclose(STRESS(m, Q @ F), turned, atol=1e-12 * scale)


@pytest.mark.parametrize("elasticity", [*SOLIDS, *FLUIDS])
def test_no_stress_and_linear_elasticity_around_rest(x64, elasticity):
    m = material(elasticity)
    rest = jnp.broadcast_to(jnp.eye(3), (NUM, 3, 3))
    np.testing.assert_allclose(STRESS(m, rest), 0.0, atol=1e-9)
    dF = jnp.asarray(np.random.default_rng(0).standard_normal((NUM, 3, 3)))
    _, tangent = jax.jvp(lambda F: materials.kirchhoff_stress(m, F), (rest,), (dF,))
    strain = 0.5 * (dF + jnp.swapaxes(dF, -1, -2))
    mu, lam = {QuadraticFluid: (0.0, LAM), Tait: (0.0, 1000.0 * SOUND**2)}.get(elasticity, (MU, LAM))
    hooke = 2 * mu * strain + lam * jnp.trace(strain, axis1=-2, axis2=-1)[:, None, None] * jnp.eye(3)
    np.testing.assert_allclose(tangent, hooke, rtol=1e-10, atol=1e-9 * E)


@pytest.mark.parametrize("elasticity", [*SOLIDS, *FLUIDS])
@given(seed=hs.integers(0, 10_000))
def test_stress_is_the_derivative_of_the_energy(x64, stretched, elasticity, seed):
    m, F = material(elasticity), random_F(stretched, seed, 0.7)
    _, P = ENERGY(m, F)
    tau = STRESS(m, F)
    np.testing.assert_allclose(P @ jnp.swapaxes(F, -1, -2), tau, atol=1e-11 * np.abs(tau).max())


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
    if plasticity is not None:
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
    for p in materials.parameters_of(direction[0]):
        path = p.path
        if path != "density" or elasticity is Tait:
            moves[path] = (replace_leaf(still[0], path, p.value), still[1])
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


CLOSE = np.array([1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 3e-3, 6e-3, 1e-2])
"""Gaps between stretches. All particles shear by 2 % of strain beside them, so dough, sand and snow flow."""


def close_stretches(stretched) -> np.ndarray:
    compressed = np.array([[0.98 + g, 0.98, 0.95] for g in CLOSE])
    pulled = np.array([[1.04, 0.99 + g, 0.99] for g in CLOSE])
    return stretched(0, np.concatenate([compressed, pulled] * (NUM // (2 * len(CLOSE)))))


def tangents(m, F, dF):
    """Derivative of the new deformation and of the stress in parts of E."""
    _, (new, tau, *_) = jax.jvp(lambda F: respond(m, F), (F,), (dF,))
    return np.asarray(new, np.float64), np.asarray(tau, np.float64) / E


@pytest.mark.parametrize(("elasticity", "plasticity"), [law for law in LAWS if law[0] not in FLUIDS])
def test_float32_derivatives_are_those_of_float64_however_close_the_stretches(
    x64, stretched, random_like, elasticity, plasticity
):
    """A gap of 0.5 % is not zero beside a yield strain of 1 %."""
    m = material(elasticity, plasticity)
    F = jnp.asarray(close_stretches(stretched), jnp.float32)
    dF = random_like(0, F)
    dF = dF / jnp.sqrt(jnp.sum(dF**2, axis=(1, 2), keepdims=True))
    exact = tangents(m, F.astype(jnp.float64), dF.astype(jnp.float64))
    single = tangents(jax.tree.map(lambda a: a.astype(jnp.float32), m), F, dF)
    for one, other in zip(single, exact, strict=True):
        error = np.linalg.norm((one - other).reshape(NUM, -1), axis=1) / np.linalg.norm(other.reshape(NUM, -1), axis=1)
        assert error.max() < 2e-4, dict(zip(CLOSE, error, strict=False))


@pytest.mark.parametrize(("elasticity", "plasticity"), [law for law in LAWS if law[1] is not None])
def test_what_does_not_flow_keeps_its_deformation_to_the_last_bit(stretched, elasticity, plasticity):
    """A ratio of stretches that is 1 up to rounding would let volume creep, substep by substep."""
    s = np.random.default_rng(0).uniform(0.994, 0.998, (NUM, 3))  # under pressure: sand does not come apart
    F = jnp.asarray(stretched(0, s), jnp.float32)
    m = material(elasticity, plasticity, np.float32, friction_angle=1.0)
    new, _, *memory = respond(m, F)
    np.testing.assert_array_equal(new, F)
    for one in memory:
        np.testing.assert_array_equal(one, 0.97 + 0.05 * jnp.abs(F[:, 0, 1]))


def test_sound_speed_and_lame_parameters(x64):
    lame = lame_parameters(2.5, 0.25)
    assert lame.shear == pytest.approx(1.0) and lame.first == pytest.approx(1.0)
    assert float(
        materials.sound_speed(material(youngs_modulus=2.5, poissons_ratio=0.25, density=3.0))
    ) == pytest.approx(1.0)


def test_parameters_have_paths_and_each_particle_may_have_its_own(x64):
    m = material(viscosity=np.ones(NUM), fibre=np.ones((NUM, 3)), activation=2.0)
    paths = {p.path: p.per_particle for p in materials.parameters_of(m)}
    assert paths == {
        "density": False, "elasticity.youngs_modulus": False, "elasticity.poissons_ratio": False,
        "viscosity.viscosity": True, "muscle.fibre": True, "muscle.activation": False,
    }  # fmt: skip
    shared, own = materials.split_parameters(m)
    assert {name: a.shape for name, a in own.items()} == {"viscosity.viscosity": (NUM,), "muscle.fibre": (3, NUM)}
    assert shared.muscle.fibre is None and shared.viscosity.viscosity is None
    again = materials.joined_parameters(shared, own)
    jax.tree.map(np.testing.assert_array_equal, again, m)


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: Material(density=1.0, elasticity="hencky"), "elasticity is 'hencky': give a law, elasticity=Hencky(you"),
        (lambda: Material(density=1.0, elasticity=Hencky), "elasticity is <class"),
        (lambda: Material(density=1.0, elasticity=None), "elasticity is None: give a law"),
        (lambda: Material(density=1.0, elasticity=HENCKY, plasticity=10.0), "plasticity is Array(10"),
        (lambda: Material(density=1.0, elasticity=HENCKY, viscosity=HENCKY), "viscosity is Hencky("),
        (lambda: Material(density=1.0, elasticity=Tait(speed_of_sound=5.0), plasticity=VonMises(yield_stress=1.0)),
         "plasticity is VonMises with Tait, a fluid, which has no yield surface: leave plasticity out"),
    ],
)  # fmt: skip
def test_what_is_no_law_is_refused(build, sentence):
    with pytest.raises(ValueError, match="^" + re.escape(sentence)) as error:
        build()
    assert "\n" not in str(error.value)


def test_materials_say_how_they_look(x64):
    looks = {
        "water": Material(density=1.0, elasticity=Tait(speed_of_sound=5.0)), "elastic": material(),
        "dough": material(plasticity=VonMises), "sand": material(plasticity=DruckerPrager),
        "snow": material(plasticity=Snow), "muscle": material(fibre=np.eye(3)[0], activation=1.0),
    }  # fmt: skip
    assert all(m.look == look for look, m in looks.items())


def test_a_law_whose_class_is_not_decorated_is_refused():
    class Bare(Hencky):
        """Not decorated."""

    with pytest.raises(
        ValueError, match=r"^elasticity is a Bare, which is no pytree: decorate it with rewax\.struct\."
    ):
        Material(density=1e3, elasticity=Bare(**vars(HENCKY)))
