"""Packed particles for the inner loop: all components in one array of shape (24 + k, num_particles)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.linear_primitive import Arrays, linear_call
from rewax.physics.mpm.scene import MPMState
from rewax.physics.mpm.transfer_xla_cpu import as_matrix, as_vector
from rewax.physics.numerics.components import Mat3, Vec3
from rewax.types import Array


class Particles(NamedTuple):
    """``MPMState`` by components."""

    x: Vec3
    v: Vec3
    C: Mat3
    F: Mat3
    memory: tuple[Array, ...]
    """History variables, k arrays."""


def split(state: MPMState) -> Array:
    """Packed particles, shape (24 + k, num_particles): rows x, v, C, F, memory.

    The loop carries and the backward pass stores this one array. ``unpack`` returns the components.
    """
    count = state.x.shape[0]
    numbers = [leaf.reshape(count, -1) for leaf in (state.x, state.v, state.C, state.F)]
    if state.memory is not None:
        numbers.append(state.memory)
    return jnp.concatenate(numbers, axis=1).T


def join(packed: Array) -> MPMState:
    """Inverse of ``split``."""
    rows, count = packed.T, packed.shape[1]
    return MPMState(
        x=rows[:, :3],
        v=rows[:, 3:6],
        C=rows[:, 6:15].reshape(count, 3, 3),
        F=rows[:, 15:24].reshape(count, 3, 3),
        memory=rows[:, 24:] if rows.shape[1] > 24 else None,
    )


def pack(components: Any) -> Array:
    """Stack components, arrays (num_particles,), as the rows of one array. Gradient: exact."""
    return linear_call(_stack, _unstack, None, (), jax.tree.leaves(components))[0]


def rows_of(packed: Array) -> Arrays:
    """Inverse of ``pack``. Gradient: exact."""
    return linear_call(_unstack, _stack, None, (), (packed,))


def unpack(packed: Array) -> Particles:
    """Particles by components. Gradient: exact."""
    rows = rows_of(packed)
    x, v = as_vector(rows[:3]), as_vector(rows[3:6])
    return Particles(x, v, as_matrix(rows[6:15]), as_matrix(rows[15:24]), tuple(rows[24:]))


def _stack(static: None, residuals: Arrays, arrays: Arrays) -> Arrays:
    del static, residuals
    return (jnp.stack(arrays, axis=-2),)


def _unstack(static: None, residuals: Arrays, arrays: Arrays) -> Arrays:
    del static, residuals
    return tuple(arrays[0][..., i, :] for i in range(arrays[0].shape[-2]))


__all__ = ["Particles", "join", "pack", "rows_of", "split", "unpack"]
