"""Positions of nodes in the frames of moving shapes, and velocities of the shapes' points at nodes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose, product, turned
from rewax.types import Array


class Motion(NamedTuple):
    """Velocity field of a rigid body: the point r [m] moves with ``turn @ r + shift`` [m/s]."""

    turn: Array
    """Shape (..., 3, 3) [1/s]."""
    shift: Array
    """Shape (..., 3) [m/s]."""


class Placed(NamedTuple):
    """Placement and motion of a shape during a substep. The context defines the leading axes (time, colliders).

    The position of a node in the shape's frame and the body's velocity there are affine in the node's position.
    """

    pose: Pose
    """Pose of the shape at the substep's beginning, shapes (..., 3), (..., 3, 3)."""
    matrix: Array
    """Shape (..., 6, 3): the first three rows give the position [-], the last three the velocity [1/s]."""
    offset: Array
    """Shape (..., 6) [m], [m/s]."""


def placed(pose: Pose, motion: Motion) -> Placed:
    """Placement of one or many shapes with the given pose (the shape's, not its body's) and motion. Gradient: exact."""
    to_local = jnp.swapaxes(pose.rotation, -1, -2)
    return Placed(
        pose,
        jnp.concatenate([to_local, motion.turn], axis=-2),
        jnp.concatenate([-turned(to_local, pose.position), motion.shift], axis=-1),
    )


def chord_motion(start: Pose, end: Pose, dt: float) -> Motion:
    """Motion along straight lines: each point of a body moves from one pose to the other. Gradient: exact."""
    turn = product((end.rotation - start.rotation) / dt, jnp.swapaxes(start.rotation, -1, -2))
    return Motion(turn, (end.position - start.position) / dt - turned(turn, start.position))


def at_nodes(placed: Placed, position: Vec3) -> tuple[Vec3, Vec3]:
    """Positions of nodes in a shape's frame [m], and the velocity of its body's points there [m/s].

    Args:
      placed: placement of the shape, without leading axes.
      position: node positions [m], components of shape (num_nodes,).

    Gradient: exact with respect to the placement, none with respect to positions.
    """
    lx, ly, lz, vx, vy, vz = linear_call(_affine, _AFFINE_TRANSPOSE, None, position, (placed.matrix, placed.offset))
    return (lx, ly, lz), (vx, vy, vz)


def velocity_at(motion: Motion, position: Vec3) -> Vec3:
    """Velocity of a body's points at nodes [m/s]. Gradient: exact with respect to the motion."""
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
    # One matrix product over contiguous rows: many small products, or sums by component, cost four times as much.
    rows = materialize(jnp.stack([*residuals, jnp.ones_like(residuals[0])], axis=-2))
    both = jnp.einsum("...kn,...cn->...kc", jnp.stack(cotangents, axis=-2), rows, precision="highest")
    return both[..., :3], both[..., 3]


def _sums_over_nodes(static: None, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """``_affine_transpose`` as one reduction over many arrays: one GPU kernel that reads everything once."""
    del static
    terms = [term for c in cotangents for term in (c, *(c * x for x in residuals))]
    zeros = [jnp.zeros((), t.dtype) for t in terms]
    sums = jax.lax.reduce(terms, zeros, lambda a, b: [x + y for x, y in zip(a, b, strict=True)], (terms[0].ndim - 1,))
    sums = jnp.stack(sums, axis=-1).reshape(*sums[0].shape, len(cotangents), 4)
    return sums[..., 1:], sums[..., 0]


_AFFINE_TRANSPOSE = ByPlatform(cpu=_affine_transpose, other=_sums_over_nodes)
