"""Random deformations and the response of a material to them, for the checks of laws."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.mpm import Material
from rewax.physics.mpm.materials import respond
from rewax.physics.numerics import components as cp
from rewax.types import Array, PyTree

NUM = 64
"""Number of deformations."""


def deformations(rng: np.random.Generator, strain: float, stretches: np.ndarray | None = None) -> Array:
    """Random rotations times stretches times random rotations, (NUM, 3, 3)."""
    s = np.exp(rng.uniform(-strain, strain, (NUM, 3))) if stretches is None else stretches
    return jnp.asarray(rotations(rng, len(s)) @ (s[:, :, None] * rotations(rng, len(s))))


def rotations(rng: np.random.Generator, num: int) -> np.ndarray:
    """Random rotations, (num, 3, 3)."""
    q, r = np.linalg.qr(rng.normal(size=(num, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None, :]
    return q * np.linalg.det(q)[:, None, None]


@jax.jit
def response(material: Material, F: Array, C: Array, memory: tuple[Array, ...]) -> tuple[Array, Array, tuple]:
    """Deformation after flow, stress and memory, for deformations and velocity gradients of shape (NUM, 3, 3)."""
    r = respond(material, cp.split_matrix(F), velocity_gradient=cp.split_matrix(C), memory=memory)
    return cp.join_matrix(r.F), cp.join_matrix(r.stress), r.memory


def at_start(material: Material, F: Array) -> tuple[Array, ...]:
    """Initial memory of particles with these deformations."""
    return tuple(jnp.full(F.shape[0], a, F.dtype) for a in material.initial_memory)


def near(a: PyTree, b: PyTree, size: Any, what: str, remedy: str, tolerance: float = 1e-9) -> None:
    """Raises AssertionError unless the trees agree within ``tolerance`` times ``size``."""
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        error = float(jnp.max(jnp.abs(one - other)) / size)
        assert error < tolerance, f"{what} (relative difference {error:.1e}): {remedy}"


def size_of(a: Array) -> Array:
    """The largest absolute value in an array, for relative differences."""
    return jnp.maximum(jnp.max(jnp.abs(a)), 1e-30)


def expand(a: Array) -> Array:
    """Numbers of particles, (n,) -> (n, 1, 1), to multiply matrices."""
    return a[:, None, None]


__all__ = ["NUM", "at_start", "deformations", "expand", "near", "response", "rotations", "size_of"]
