"""Volume and inertia of the region of negative distance, by quadrature on a grid.

The distance is interpolated linearly in six tetrahedra per cell. The part of a tetrahedron below zero is exact, so the
error is of second order in the cell size.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.physics.shapes.solid import Solid, corners_of, distance_to
from rewax.types import Array, Scalar

NUM_CELLS = 64
"""Cells along each axis of a bounding box."""
_LARGEST_ERROR = 0.01
"""Of a volume, relative."""
_OFF_CENTER = 1e-3
"""A centre of mass may be this far from the origin, in longest edges of the bounding box: ten times the error."""


def fractions_inside(shape: Solid) -> tuple[Array, Array, Array]:
    """Fraction of each cell of the bounding box that lies inside.

    Returns:
      Fractions from 0 to 1, shape (n, n, n); lower and upper corner of the box [m], shape (3,) each.

    Raises:
      ValueError: the shape is concrete, and the estimated error of its volume exceeds 1 %.

    Gradient: exact for the returned values, with respect to the shape's sizes.
    """
    lower, upper = (jnp.asarray(corner) for corner in corners_of(shape))
    fractions, means = _fractions(shape, lower, upper)
    if not isinstance(means, Tracer):
        fine, coarse = np.asarray(means).tolist()
        error = abs(fine - coarse) / 3.0  # of second order: a quarter of that on cells twice as large
        if fine == 0.0 or error > _LARGEST_ERROR * fine:
            raise ValueError(
                f"{type(shape).__name__} is too thin for a quadrature on {NUM_CELLS} cells along each axis of its "
                f"bounding box, whose estimated error is {100 * error / fine if fine else 100:.2g} % of the volume: "
                "write its methods volume and inertia"
            )
    return fractions, lower, upper


@jax.jit
def _fractions(shape: Solid, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Those of all cells; their mean, and that on cells of twice the size, without gradient, shape (2,)."""
    steps = jnp.arange(NUM_CELLS + 1, dtype=jnp.result_type(lower, upper, float)) / NUM_CELLS
    x, y, z = jnp.meshgrid(*((lower + steps[:, None] * (upper - lower)).T), indexing="ij")
    values, _ = distance_to(shape, (x.reshape(-1), y.reshape(-1), z.reshape(-1)))
    values = values.reshape(x.shape)
    fine, coarse = (jnp.sum(fractions_below_zero(v), axis=0) / 6.0 for v in (values, values[::2, ::2, ::2]))
    return fine, jax.lax.stop_gradient(jnp.stack([jnp.mean(fine), jnp.mean(coarse)]))


def volume(fractions: Array, lower: Array, upper: Array) -> Array:
    """Volume [m^3] from the result of ``fractions_inside``. Gradient: exact."""
    return jnp.mean(fractions) * jnp.prod(upper - lower)


def inertia(name: str, density: Scalar, fractions: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Mass [kg] and moments of inertia about the origin [kg m^2], shape (3, 3), from ``fractions_inside``.

    Raises:
      ValueError: the centre of mass is concrete and not the origin. The message calls the shape ``name``.

    Gradient: exact.
    """
    steps = (jnp.arange(NUM_CELLS, dtype=fractions.dtype) + 0.5) / NUM_CELLS
    axes = (lower + steps[:, None] * (upper - lower)).T
    whole = volume(fractions, lower, upper)
    share = fractions / jnp.sum(fractions)

    def mean(*factors: int) -> Array:
        weighted = share
        for i in factors:
            weighted = weighted * axes[i].reshape([-1 if i == axis else 1 for axis in range(3)])
        return jnp.sum(weighted)

    _check_center(name, jnp.stack([mean(i) for i in range(3)]), upper - lower)
    within_cell = ((upper - lower) / NUM_CELLS) ** 2 / 12.0
    second = jnp.stack([jnp.stack([mean(i, j) for j in range(3)]) for i in range(3)]) + jnp.diag(within_cell)
    mass = density * whole
    return mass, mass * (jnp.trace(second) * jnp.eye(3, dtype=second.dtype) - second)


def _check_center(name: str, center: Array, size: Array) -> None:
    if isinstance(center, Tracer) or isinstance(size, Tracer):
        return
    if not np.all(np.abs(center) <= _OFF_CENTER * np.max(size)):
        x, y, z = np.asarray(center)
        raise ValueError(
            f"the centre of mass of the {name} is ({x:.3g}, {y:.3g}, {z:.3g}), but must be the origin of its frame, as "
            "for every free body: shift the shape, or give an Inertia(mass=..., moment=...)"
        )


@jax.jit
def fractions_below_zero(values: Array) -> Array:
    """Fraction of each of a cell's six tetrahedra in which the interpolant is negative.

    Args:
      values: values at the nodes, shape (nx, ny, nz).

    Returns:
      Fractions from 0 to 1, shape (6, nx - 1, ny - 1, nz - 1). Gradient: exact.
    """
    size = [n - 1 for n in values.shape]
    corner: dict[tuple[int, ...], Array] = {
        c: values[c[0] : c[0] + size[0], c[1] : c[1] + size[1], c[2] : c[2] + size[2]]
        for c in itertools.product((0, 1), repeat=3)
    }
    # Each tetrahedron's corners are a path from 000 to 111, one axis after the other.
    orders = list(itertools.permutations(range(3)))
    tetrahedra = jnp.stack(
        [jnp.stack([corner[tuple(int(a in o[:k]) for a in range(3))] for o in orders]) for k in range(4)]
    )
    return _fraction_below_zero(jnp.sort(tetrahedra, axis=0))


def _fraction_below_zero(v: Array) -> Array:
    """Fraction of a tetrahedron in which the linear function with these corner values is negative.

    Args:
      v: values at the corners, ascending along the first axis, shape (4, ...).
    """

    def cut(i: int, j: int) -> Array:
        """Position of the zero along the edge from a negative corner i to a non-negative corner j, from 0 to 1."""
        crosses = (v[i] < 0) & (v[j] >= 0)
        return jnp.where(crosses, v[i] / jnp.where(crosses, v[i] - v[j], 1.0), 0.0)

    one = cut(0, 1) * cut(0, 2) * cut(0, 3)
    a, b, c, d = cut(0, 2), cut(0, 3), cut(1, 2), cut(1, 3)
    two = a * b + a * (1.0 - b) * d + (1.0 - a) * c * d
    three = 1.0 - (1.0 - cut(0, 3)) * (1.0 - cut(1, 3)) * (1.0 - cut(2, 3))
    some = jnp.where(v[2] < 0, three, jnp.where(v[1] < 0, two, one))
    # A tetrahedron whose highest corner lies on the surface is full, with the derivative of one that sticks out.
    return jnp.where(v[3] < 0, 1.0, jnp.where(v[0] < 0, some, jnp.where(v[3] <= 0, 1.0, 0.0)))


__all__ = ["fractions_below_zero", "fractions_inside", "inertia", "volume"]
