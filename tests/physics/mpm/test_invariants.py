"""The formulas, against bodies whose mass, momentum and energy are known."""

import jax.numpy as jnp
import numpy as np
from flat_materials import flat_material

from rewax.physics import mpm
from rewax.physics.mpm import Hencky, VonMises, invariants
from rewax.physics.mpm.grid import Grid
from rewax.physics.shapes.sampling import fill_box

DENSITY, SPACING = 1200.0, 0.1
OMEGA, SHIFT = np.array([0.3, -1.0, 2.0]), np.array([1.0, 2.0, -0.5])


def block(F=None, **changes):
    x = fill_box((0.5, 0.4, 0.6), (0.2, 0.4, 0.2), 0.05)
    material = flat_material(youngs_modulus=1e4, poissons_ratio=0.3, density=DENSITY, **changes)
    scene = mpm.make_scene(
        grid=Grid(shape=(9, 8, 10), spacing=SPACING), dt=1e-4, material=material, particle_volume=0.016 / len(x),
        gravity=(0.0, -10.0, 1.0),
    )  # fmt: skip
    state = mpm.initial_state(x)
    return scene, state if F is None else state.replace(F=jnp.broadcast_to(jnp.asarray(F), state.F.shape))


def rigid_motion(state):
    """v = SHIFT + OMEGA x (r - centre), with its gradient as the affine field."""
    spin = np.array([[0, -OMEGA[2], OMEGA[1]], [OMEGA[2], 0, -OMEGA[0]], [-OMEGA[1], OMEGA[0], 0]])
    r = np.asarray(state.x) - np.mean(state.x, axis=0)
    return state.replace(v=jnp.asarray(SHIFT + r @ spin.T), C=jnp.broadcast_to(jnp.asarray(spin), state.C.shape))


def inertia(state) -> np.ndarray:
    """Inertia tensor about the centre of point masses plus the affine field's 2 dx^2/4 I for each."""
    mass = DENSITY * 0.016 / len(state.x)
    r = np.asarray(state.x) - np.mean(state.x, axis=0)
    points = np.einsum("ni,ni->", r, r) * np.eye(3) - r.T @ r
    return mass * (points + len(r) * 2 * SPACING**2 / 4 * np.eye(3))


def test_mass_and_momentum_of_a_rigid_motion(x64):
    scene, state = block()
    state = rigid_motion(state)
    mass = DENSITY * 0.016
    np.testing.assert_allclose(invariants.total_mass(scene, state), mass, rtol=1e-12)
    np.testing.assert_allclose(invariants.momentum(scene, state), mass * SHIFT, rtol=1e-12)
    spin = inertia(state) @ OMEGA
    center = np.mean(state.x, axis=0)
    np.testing.assert_allclose(invariants.angular_momentum(scene, state, center), spin, rtol=1e-12)
    np.testing.assert_allclose(
        invariants.angular_momentum(scene, state), spin + mass * np.cross(center, SHIFT), rtol=1e-12
    )


def test_energies_of_a_rigid_motion_and_of_a_stretch(x64):
    scene, state = block()
    mass = DENSITY * 0.016
    moving = rigid_motion(state)
    kinetic = 0.5 * mass * SHIFT @ SHIFT + 0.5 * OMEGA @ inertia(state) @ OMEGA
    np.testing.assert_allclose(invariants.kinetic_energy(scene, moving), kinetic, rtol=1e-12)
    potential = mass * (10.0 * 0.4 - 1.0 * 0.6)
    np.testing.assert_allclose(invariants.gravitational_energy(scene, moving), potential, rtol=1e-12)
    np.testing.assert_allclose(invariants.elastic_energy(scene, moving), 0.0, atol=1e-12)

    scene, stretched = block(np.diag([1.1, 1.0, 1.0]))
    modulus = 1e4 * 0.7 / (1.3 * 0.4)  # lambda + 2 mu
    elastic = 0.016 * 0.5 * modulus * np.log(1.1) ** 2
    np.testing.assert_allclose(invariants.elastic_energy(scene, stretched), elastic, rtol=1e-12)
    np.testing.assert_allclose(invariants.total_energy(scene, stretched), potential + elastic, rtol=1e-12)


def test_elastic_energy_is_the_one_after_plastic_flow(x64):
    """Isochoric strain (a, -a, 0) far beyond yield keeps deviatoric energy yield^2 / (4 mu) per volume."""
    scene, state = block(
        np.diag([np.e, 1 / np.e, 1.0]),
        yield_stress=200.0,
        plasticity=VonMises,
        elasticity=Hencky,
    )
    mu = 1e4 / 2.6
    np.testing.assert_allclose(invariants.elastic_energy(scene, state), 0.016 * 200.0**2 / (4 * mu), rtol=1e-10)
