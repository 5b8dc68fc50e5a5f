"""Positions and orientations of rigid bodies."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from rewax.physics.numerics.checks import static_integer
from rewax.types import Array


class Pose(NamedTuple):
    """Positions and orientations of rigid bodies. The context defines the leading axes (time, bodies)."""

    position: Array
    """Origin of the body's frame in the world [m], shape (..., 3)."""
    rotation: Array
    """Rotation matrix from the body's frame to the world's, shape (..., 3, 3)."""


def turned(rotation: Array, vector: Array) -> Array:
    """``rotation @ vector``, (..., 3, 3), (..., 3), as sums that fuse into other kernels. Gradient: exact."""
    return sum(rotation[..., k] * vector[..., k, None] for k in range(3))  # type: ignore[return-value]


def product(a: Array, b: Array) -> Array:
    """``a @ b`` of matrices (..., 3, 3), as sums like ``turned``. Gradient: exact."""
    return sum(a[..., k, None] * b[..., None, k, :] for k in range(3))  # type: ignore[return-value]


def placed_at(mount: Pose, body: Pose) -> Pose:
    """World pose of a frame with pose ``mount`` in the body's frame. Gradient: exact."""
    return Pose(body.position + turned(body.rotation, mount.position), product(body.rotation, mount.rotation))


def body_pose(poses: Pose, body: int) -> Pose:
    """Pose of one body, shapes (3,) and (3, 3), from those of all, shapes (num_bodies, 3) and (num_bodies, 3, 3).

    Gradient: exact.
    """
    return Pose(poses.position[body], poses.rotation[body])


def static_poses(num_substeps: int, num_bodies: int = 0, dtype: Any = None) -> Pose:
    """Poses of bodies that stay at the origin, at the boundaries of substeps.

    Args:
      num_substeps: number of substeps, >= 0.
      num_bodies: number of bodies, >= 0.
      dtype: of the arrays; None: JAX's default float type.

    Returns:
      Poses of shapes (num_substeps + 1, num_bodies, 3) and (num_substeps + 1, num_bodies, 3, 3).

    Raises:
      ValueError: a number is no integer or below 0.
    """
    num_substeps = static_integer("num_substeps", num_substeps, 0, "give the number of substeps")
    num_bodies = static_integer("num_bodies", num_bodies, 0, "give the number of bodies")
    shape = (num_substeps + 1, num_bodies)
    return Pose(jnp.zeros((*shape, 3), dtype), jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*shape, 3, 3)))
