"""A cube of particles, its scene, and motions to give it, for tests of particles."""

import jax
import jax.numpy as jnp
import numpy as np
from flat_materials import flat_material

from rewax.physics import mpm
from rewax.physics.mpm import Hencky
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.materials import Material, sound_speed
from rewax.physics.shapes.sampling import sample_box

DT, NUM_SUBSTEPS, NUM = 1e-4, 1000, 64
GRID = Grid(shape=(12, 14, 12), spacing=0.05, origin=(-0.3, -0.35, -0.3))
SIDE = 0.1
STEP = jax.jit(mpm.step, static_argnames="store_every")
"""Compiled once for each grid, law, number of particles and of substeps: tests share these."""


def modulus_at(courant_number: float, density: float = 1000.0, nu: float = 0.3) -> float:
    """Young's modulus with which DT is this multiple of the time that sound takes through a cell."""
    unit = float(sound_speed(Material(density=density, elasticity=Hencky(youngs_modulus=1.0, poissons_ratio=nu))))
    return (courant_number * GRID.spacing / (DT * unit)) ** 2


def cube(
    courant_number=0.05,
    gravity=(0.0, 0.0, 0.0),
    seed=0,
    elasticity=Hencky,
    plasticity=None,
    **changes,
):
    """A cube of random particles in the middle of the grid, away from its border, and its scene."""
    material = flat_material(
        youngs_modulus=modulus_at(courant_number), poissons_ratio=0.3, density=1000.0, yield_stress=1e3,
        elasticity=elasticity, plasticity=plasticity,
    )  # fmt: skip
    material = jax.tree.map(lambda a: jnp.asarray(a, float), material)
    scene = mpm.MPMScene(
        grid=GRID,
        dt=DT,
        material=material,
        particle_volume=jnp.asarray(SIDE**3 / NUM),
        gravity=jnp.asarray(gravity),
        **changes,
    )
    state = mpm.initial_state(sample_box(jax.random.key(seed), (0.0, 0.0, 0.0), (SIDE,) * 3, NUM))
    return scene, state


def run(scene, state, num_substeps=NUM_SUBSTEPS):
    return STEP(scene, state, mpm.static_poses(num_substeps))


def spinning(state, omega=(1.0, -2.0, 3.0), noise=0.0, seed=1):
    w = np.asarray(omega)
    spin = jnp.asarray([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]], state.x.dtype)
    v = state.x @ spin.T + noise * jax.random.normal(jax.random.key(seed), state.x.shape)
    return state.replace(v=v, C=jnp.broadcast_to(spin, state.C.shape))


def relative(a, b) -> float:
    return float(np.linalg.norm(np.asarray(a, np.float64) - np.asarray(b, np.float64)) / np.linalg.norm(np.asarray(b)))
