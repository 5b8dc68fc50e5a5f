"""Materials with numbers, random deformations, and compiled laws, for tests of laws and materials."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flat_materials import flat_material

from rewax.physics.mpm import (
    DruckerPrager,
    FixedCorotated,
    Hencky,
    Material,
    NeoHookean,
    QuadraticFluid,
    Snow,
    Tait,
    VonMises,
    materials,
)
from rewax.physics.numerics import components as cp

NUM = 32
"""All tests use as many matrices, so that they share compiled operations."""
SOLIDS = [Hencky, FixedCorotated, NeoHookean]
FLUIDS = [QuadraticFluid, Tait]
PLASTIC = [VonMises, DruckerPrager, Snow]
LAWS = [*itertools.product(SOLIDS, [None, *PLASTIC]), *itertools.product(FLUIDS, [None])]
E, NU, YIELD, SOUND = 1e4, 0.3, 300.0, 5.0
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
PARAMETERS = {
    "youngs_modulus": E, "poissons_ratio": NU, "density": 1000.0, "yield_stress": YIELD, "friction_angle": 0.5,
    "cohesion": 0.01, "critical_compression": 0.025, "critical_stretch": 0.0075, "hardening": 10.0,
    "speed_of_sound": SOUND,
}  # fmt: skip


def material(elasticity=Hencky, plasticity=None, dtype=np.float64, **changes) -> Material:
    arrays = {name: jnp.asarray(value, dtype) for name, value in (PARAMETERS | changes).items()}
    return flat_material(elasticity, plasticity, **arrays)


def random_F(stretched, seed: int, amount: float = 0.3) -> jax.Array:
    """Deformations with log stretches up to ``amount``."""
    logs = np.random.default_rng(seed).uniform(-amount, amount, (NUM, 3))
    return jnp.asarray(stretched(seed, np.exp(logs)))


def respond(m: Material, F: jax.Array) -> tuple[jax.Array, ...]:
    """Deformation after flow, stress, memory."""
    memory = tuple(0.97 + 0.05 * jnp.abs(F[:, 0, 1]) for _ in m.initial_memory)
    response = materials.respond(m, cp.split_matrix(F), memory=memory)
    return cp.join_matrix(response.F), cp.join_matrix(response.stress), *response.memory


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
