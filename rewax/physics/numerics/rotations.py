"""Rotations as unit quaternions (w, x, y, z), MuJoCo's convention."""

import jax.numpy as jnp

from rewax.lowering.structural import structural_zeros
from rewax.types import Array, Scalar


def normalized(a: Array) -> Array:
    """Vectors of length 1, (..., n) -> (..., n). Gradient: exact; not finite for a vector of zeros.

    The sum is written out: a reduction would be a separate kernel on a GPU.
    """
    square = sum(a[..., i] * a[..., i] for i in range(a.shape[-1]))
    return a / jnp.sqrt(square)[..., None]


def quaternion_to_matrix(q: Array) -> Array:
    """Rotation matrix of a unit quaternion, (..., 4) -> (..., 3, 3). Gradient: exact."""
    w, x, y, z = (q[..., i] for i in range(4))
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(matrix: Array) -> Array:
    """One of the two unit quaternions of a rotation matrix, (..., 3, 3) -> (..., 4). Gradient: exact."""
    xx, yy, zz = (matrix[..., i, i] for i in range(3))
    (zy, yz), (xz, zx), (yx, xy) = ((matrix[..., i, j], matrix[..., j, i]) for i, j in ((2, 1), (0, 2), (1, 0)))
    # Row i is the quaternion times 4 q_i. The row with the largest diagonal entry is normalised.
    rows = (
        (1.0 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1.0 + xx - yy - zz, xy + yx, xz + zx),
        (xz - zx, xy + yx, 1.0 - xx + yy - zz, yz + zy),
        (yx - xy, xz + zx, yz + zy, 1.0 - xx - yy + zz),
    )
    table = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    largest = jnp.argmax(jnp.diagonal(table, axis1=-2, axis2=-1), axis=-1)
    row = jnp.take_along_axis(table, largest[..., None, None], axis=-2)[..., 0, :]
    return normalized(row)


def quaternion_product(a: Array, b: Array) -> Array:
    """The rotation b followed by a, (..., 4) each. Gradient: exact."""
    w, v, u, r = a[..., :1], a[..., 1:], b[..., 1:], b[..., :1]
    scalar = w * r - jnp.sum(v * u, axis=-1, keepdims=True)
    return jnp.concatenate([scalar, w * u + r * v + jnp.cross(v, u)], axis=-1)


def rotation_vector(q: Array) -> Array:
    """Axis times angle of a unit quaternion, with an angle in [-pi, pi], (..., 4) -> (..., 3).

    Gradient: exact, also at the identity.
    """
    w, v = q[..., :1], q[..., 1:]
    square = jnp.sum(v * v, axis=-1, keepdims=True)
    small = square < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    angle = 2.0 * jnp.arctan2(sine, jnp.where(small, 0.0, w))
    angle = jnp.where(angle > jnp.pi, angle - 2.0 * jnp.pi, angle)
    near = jnp.where(small, w, 1.0)
    return v * jnp.where(small, 2.0 / near - 2.0 / 3.0 * square / near**3, angle / sine)


def turn_quaternion(q: Array, angular_velocity: Array, dt: Scalar) -> Array:
    """Orientation after a short time.

    Args:
      q: unit quaternion, shape (..., 4).
      angular_velocity: in the world's frame [rad/s], shape (..., 3).
      dt: duration [s]. The angle is 2 atan(a / 2) for a = |angular_velocity| dt: about a^3 / 12 [rad] too small.

    Returns:
      Unit quaternion, shape (..., 4): q + dt/2 (0, angular_velocity) q, normalised.

    Gradient: exact.
    """
    rate = jnp.concatenate([jnp.zeros_like(q[..., :1]), angular_velocity.astype(q.dtype)], axis=-1)
    turned = q + 0.5 * dt * quaternion_product(rate, q)
    return normalized(turned)


def skew(a: Array) -> Array:
    """The matrix S with S b = a x b, (..., 3) -> (..., 3, 3)."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    zero = jnp.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return structural_zeros(jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2))
