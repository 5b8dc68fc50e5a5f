"""Materials with numbers, random deformations, and compiled laws, for tests of laws and materials."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

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
