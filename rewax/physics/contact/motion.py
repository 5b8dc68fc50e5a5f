"""How moving shapes are placed among nodes, and the velocity of their points there."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose, product, turned
from rewax.types import Array


class Motion(NamedTuple):
    """Velocity of a rigid body's points: that of the point r [m] is ``turn @ r + shift`` [m/s]."""

    turn: Array
    """Shape (..., 3, 3) [1/s]."""
    shift: Array
    """Shape (..., 3) [m/s]."""


class Placed(NamedTuple):
    """Where a shape is during a substep and how it moves. Leading axes (time, colliders) as the context says.

    Both the place of a node in the shape's frame and the body's velocity there are affine in the node's position.
    """

    pose: Pose
    """Of the shape at the substep's beginning, shapes (..., 3), (..., 3, 3)."""
    matrix: Array
    """Shape (..., 6, 3): first rows for the place [-], last for the velocity [1/s]."""
    offset: Array
    """Shape (..., 6) [m], [m/s]."""


def placed(pose: Pose, motion: Motion) -> Placed:
    """A shape, or many, of the given pose (not that of its body) and motion. Gradient: exact."""
    to_local = jnp.swapaxes(pose.rotation, -1, -2)
    return Placed(
        pose,
        jnp.concatenate([to_local, motion.turn], axis=-2),
        jnp.concatenate([-turned(to_local, pose.position), motion.shift], axis=-1),
    )


def chord_motion(start: Pose, end: Pose, dt: float) -> Motion:
    """The motion that takes each point of a body along a straight line from one pose to another. Gradient: exact."""
    turn = product((end.rotation - start.rotation) / dt, jnp.swapaxes(start.rotation, -1, -2))
    return Motion(turn, (end.position - start.position) / dt - turned(turn, start.position))


def at_nodes(placed: Placed, position: Vec3) -> tuple[Vec3, Vec3]:
    """Where nodes are in a shape's frame [m], and the velocity of its body's points there [m/s].

    Args:
      placed: the shape, without leading axes.
      position: where the nodes are [m], components of shape (num_nodes,).

    Gradient: exact with respect to the placement, none to the positions.
    """
    lx, ly, lz, vx, vy, vz = linear_call(_affine, _AFFINE_TRANSPOSE, None, position, (placed.matrix, placed.offset))
    return (lx, ly, lz), (vx, vy, vz)


def velocity_at(motion: Motion, position: Vec3) -> Vec3:
    """Velocity of a body's points at the given nodes [m/s]. Gradient: exact with respect to the motion."""
    x, y, z = linear_call(_affine, _AFFINE_TRANSPOSE, None, position, tuple(motion))
    return x, y, z


def _affine(static: None, residuals: Arrays, linear: Arrays) -> Arrays:
    """Affine functions M (x, y, z) + m of positions (..., n): M (..., k, 3), m (..., k) -> k arrays (..., n)."""
    del static
    x, y, z = residuals
    matrix, offset = (a[..., None] for a in linear)
    return tuple(
        matrix[..., c, 0, :] * x + matrix[..., c, 1, :] * y + matrix[..., c, 2, :] * z + offset[..., c, :]
        for c in range(offset.shape[-2])
    )


def _affine_transpose(static: None, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """Sums over the nodes of cotangent times (x, y, z, 1)."""
    del static
    # One product of matrices whose rows are contiguous: many small ones, or sums by component, cost four times as much.
    rows = materialize(jnp.stack([*residuals, jnp.ones_like(residuals[0])], axis=-2))
    both = jnp.einsum("...kn,...cn->...kc", jnp.stack(cotangents, axis=-2), rows, precision="highest")
    return both[..., :3], both[..., 3]


def _sums_over_nodes(static: None, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """The same as one reduction of many arrays: one kernel of a GPU, which reads everything once."""
    del static
    terms = [term for c in cotangents for term in (c, *(c * x for x in residuals))]
    zeros = [jnp.zeros((), t.dtype) for t in terms]
    sums = jax.lax.reduce(terms, zeros, lambda a, b: [x + y for x, y in zip(a, b, strict=True)], (terms[0].ndim - 1,))
    sums = jnp.stack(sums, axis=-1).reshape(*sums[0].shape, len(cotangents), 4)
    return sums[..., 1:], sums[..., 0]


_AFFINE_TRANSPOSE = ByPlatform(cpu=_affine_transpose, other=_sums_over_nodes)
