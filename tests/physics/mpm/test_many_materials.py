"""Several materials in one scene, and what fluids, sand, snow and muscles do in one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material

from rewax.physics import mpm
from rewax.physics.mpm import DruckerPrager, FixedCorotated, Material, Muscle, Newtonian, Snow, Tait
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.invariants import momentum, total_mass
from rewax.physics.mpm.materials import respond
from rewax.physics.numerics import components as cp
from rewax.physics.shapes.sampling import fill_box
from rewax.struct import replace_leaf

GRID = Grid(shape=(12, 12, 12), spacing=0.1)
BLOCK = fill_box((0.5, 0.5, 0.5), (0.2, 0.2, 0.2), 0.05)
HALF = len(BLOCK) // 2
SOLID = flat_material(youngs_modulus=1e4, poissons_ratio=0.3, density=1000.0)
WATER = flat_material(speed_of_sound=5.0, density=800.0, viscosity=0.5, elasticity=Tait)
SNOW = flat_material(youngs_modulus=1e4, poissons_ratio=0.2, density=400.0, elasticity=FixedCorotated,
                plasticity=Snow, critical_compression=0.025, critical_stretch=0.0075, hardening=10.0)  # fmt: skip
SAND = flat_material(youngs_modulus=1e4, poissons_ratio=0.2, density=1500.0, friction_angle=0.5,
                plasticity=DruckerPrager)  # fmt: skip


def make(material, **options) -> mpm.MPMScene:
    options = {"grid": GRID, "dt": 1e-3, "particle_volume": 1.25e-4, "gravity": (0.0, 0.0, 0.0)} | options
    return mpm.make_scene(material=material, **options)


def moving(scene) -> mpm.MPMState:
    state = mpm.initial_state(jnp.asarray(BLOCK), scene)
    rng = np.random.default_rng(0)
    C = jnp.asarray(5.0 * rng.normal(size=(len(BLOCK), 3, 3)))
    return state.replace(v=jnp.asarray(rng.normal(size=(len(BLOCK), 3))), C=C, F=state.F + 0.02 * C)


STEP = jax.jit(mpm.step)
STILL = mpm.static_poses(20)


def test_materials_of_one_kind_split_in_two_are_one(x64, relative_error):
    """Also when a parameter differs per particle instead."""
    stiff = replace_leaf(SOLID, "elasticity.youngs_modulus", 2e4).replace(density=500.0)
    two = make((SOLID, stiff), particle_counts=(HALF, len(BLOCK) - HALF))
    first = jnp.arange(len(BLOCK)) < HALF
    per_particle = replace_leaf(SOLID, "elasticity.youngs_modulus", jnp.where(first, 1e4, 2e4))
    per_particle = per_particle.replace(density=jnp.where(first, 1000.0, 500.0))
    state = moving(two)
    assert relative_error(STEP(two, state, STILL), STEP(make(per_particle), state, STILL)) < 1e-12
    np.testing.assert_allclose(total_mass(two, state), 1.25e-4 * (HALF * 1000.0 + (len(BLOCK) - HALF) * 500.0))


def test_water_beside_snow_keeps_momentum_and_each_its_law(x64):
    scene = make((WATER, SNOW), particle_counts=(HALF, len(BLOCK) - HALF))
    state = moving(scene)
    end = STEP(scene, state, STILL)
    np.testing.assert_allclose(momentum(scene, end), momentum(scene, state), rtol=1e-10)
    F, _ = (np.asarray(a) for a in mpm.deform(scene, end))
    np.testing.assert_allclose(F[:HALF], np.cbrt(np.linalg.det(F[:HALF]))[:, None, None] * np.eye(3), atol=1e-12)
    s = np.linalg.svd(F[HALF:], compute_uv=False)
    assert s.min() >= 0.975 - 1e-9 and s.max() <= 1.0075 + 1e-9
    np.testing.assert_array_equal(end.memory[:HALF], 0.0)
    assert np.ptp(end.memory[HALF:]) > 0.01


@pytest.mark.parametrize(
    "material",
    [
        pytest.param(WATER, id="water"),
        # test_materials differentiates these laws, this the same step with them.
        pytest.param(SNOW, id="snow", marks=pytest.mark.slow),
        pytest.param(SAND, id="sand", marks=pytest.mark.slow),
    ],
)
def test_twenty_substeps_reverse_forward_and_finite_difference(x64, random_like, derivatives, inner, material):
    """By particles and by every parameter."""
    scene = jax.tree.map(lambda a: jnp.asarray(a, float), make(material.replace(viscosity=Newtonian(viscosity=0.3))))
    state = moving(scene)
    state = state.replace(x=state.x + 1e-3 * state.v)
    program = derivatives(lambda args: mpm.step(*args, STILL))

    def weights(end):
        return jax.tree.map(lambda a, n: n / jnp.sqrt(jnp.mean(n**2)), end, random_like(0, end))

    # All parameters at once, then all particles: test_materials takes the laws' parameters one by one.
    args = (scene, state)
    sizes = jax.tree.map(lambda a: jnp.where(jnp.isfinite(a).all(), 1e-2 + jnp.sqrt(jnp.mean(a**2)), 0.0), args)
    moves = jax.tree.map(lambda size, noise: size * noise, sizes, random_like(1, args))
    still = jax.tree.map(jnp.zeros_like, moves)
    for move in ((moves[0], still[1]), (still[0], moves[1])):
        _, tangent, cotangent, gradient = program(args, move, weights=weights)
        reverse, forward = inner(gradient, move), inner(cotangent, tangent)
        assert abs(reverse - forward) < 1e-9 * abs(forward)
        differences = []
        for h in (1e-6, 1e-7, 1e-8):
            ahead, behind = (
                program(jax.tree.map(lambda a, d: a + k * d, args, move), move, weights=weights)[0] for k in (h, -h)
            )
            differences.append((inner(ahead, cotangent) - inner(behind, cotangent)) / (2 * h))
        assert min(abs(reverse - d) for d in differences) < 1e-5 * abs(forward), (reverse, differences)


def test_viscous_stress_is_newtons(x64):
    shear = np.zeros((3, 3))
    shear[0, 1] = 3.0
    C = cp.split_matrix(jnp.asarray(shear + 0.7 * np.eye(3))[None])
    F = cp.split_matrix(1.1 * jnp.eye(3)[None])
    still, flowing = (
        cp.join_matrix(respond(m, F, velocity_gradient=C).stress)[0] for m in (WATER.replace(viscosity=None), WATER)
    )
    np.testing.assert_allclose(flowing - still, 1.1**3 * 0.5 * (shear + shear.T), atol=1e-12)


def test_active_fibres_pull_along_themselves(x64):
    muscle = SOLID.replace(muscle=Muscle(fibre=(0.0, 1.0, 0.0), activation=300.0))
    stretch = jnp.diag(jnp.asarray([1.0, 1.2, 1.0]))[None]
    passive, active = (cp.join_matrix(respond(m, cp.split_matrix(stretch)).stress)[0] for m in (SOLID, muscle))
    np.testing.assert_allclose(active - passive, np.diag([0.0, 300.0 * 1.44, 0.0]), atol=1e-9)
    # A free block of it shortens along the fibres and widens across.
    scene = make(muscle)
    end = STEP(scene, mpm.initial_state(jnp.asarray(BLOCK)), mpm.static_poses(60))
    size = np.ptp(np.asarray(end.x), axis=0) / np.ptp(BLOCK, axis=0)
    assert size[1] < 0.99 and size[0] > 1.001 and size[2] > 1.001


def test_scenes_that_do_not_fit_together_are_refused():
    with pytest.raises(ValueError, match="give a tuple of materials and the number of particles of each"):
        make((SOLID, WATER))
    with pytest.raises(ValueError, match="give a tuple of materials"):
        make(SOLID, particle_counts=(8,))
    scene = make((SOLID, WATER), particle_counts=(5, 7))
    with pytest.raises(ValueError, match=r"in sum 12, but there are \d+ particles: give the number"):
        mpm.step(scene, mpm.initial_state(jnp.asarray(BLOCK)), STILL)
    with pytest.raises(ValueError, match=r"memory has 0 arrays, but Snow needs 1: begin with mpm\.initial"):
        mpm.step(make(SNOW), mpm.initial_state(jnp.asarray(BLOCK)), STILL)
    with pytest.raises(
        ValueError, match=r"friction_angle is 25\.0, but must be above 0 and below 1\.5708: give an angle in radians"
    ):
        make(replace_leaf(SAND, "plasticity.friction_angle", 25.0))
    with pytest.raises(ValueError, match="speed_of_sound is None, but must be positive"):
        make(Material(density=1000.0, elasticity=Tait(speed_of_sound=None)))
    with pytest.raises(
        ValueError, match=r"viscosity is -1\.0, but must be 0 or more: give the dynamic viscosity in Pa s"
    ):
        make(replace_leaf(WATER, "viscosity.viscosity", -1.0))
