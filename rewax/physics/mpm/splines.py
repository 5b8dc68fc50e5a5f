"""Quadratic B-splines: weights for the exchange of mass and momentum between particles and grid nodes."""

from typing import NamedTuple

import jax.numpy as jnp

from rewax.lowering.fusion import compute_once
from rewax.types import Array


class Stencil(NamedTuple):
    """The three nodes along one axis that a particle touches."""

    base: Array
    """Index of the lowest node, int32."""
    weights: tuple[Array, Array, Array]
    """Weight of each node [-]; they sum to one."""
    slopes: tuple[Array, Array, Array]
    """Derivative of each weight by the particle's position [1/m]."""
    offsets: tuple[Array, Array, Array]
    """Node position minus particle position [m]."""


def lowest_node(x: Array, *, origin: float, spacing: float, num_nodes: int) -> Array:
    """Index of the lowest of the three nodes along one axis, int32. Arguments as for ``quadratic_bspline``."""
    cells = (x - origin) * (1.0 / spacing)
    return jnp.clip(jnp.floor(cells - 0.5).astype(jnp.int32), 0, num_nodes - 3)


def quadratic_bspline(x: Array, *, origin: float, spacing: float, num_nodes: int) -> Stencil:
    """Quadratic B-spline stencil along one axis.

    With f the distance to the lowest node in cells, in [0.5, 1.5): w0 = (1.5 - f)^2 / 2, w1 = 3/4 - (f - 1)^2,
    w2 = (f - 0.5)^2 / 2. A particle outside the grid keeps a stencil inside it; its weights are then meaningless, and
    ``check_status`` sets ``Status.OUT_OF_DOMAIN``.

    Args:
      x: particle coordinate along this axis [m], any shape.
      origin: coordinate of node 0 [m].
      spacing: distance of neighbouring nodes [m].
      num_nodes: nodes along this axis.

    Gradient: none here; the transfers have hand-written derivatives.
    Source: Jiang et al. 2016, MPM course notes, eq. 123.
    """
    # Compute floor once; fused copies may round differently.
    base = compute_once(lowest_node(x, origin=origin, spacing=spacing, num_nodes=num_nodes))
    f = (x - origin) * (1.0 / spacing) - base.astype(x.dtype)
    weights = (0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2)
    inv = 1.0 / spacing
    slopes = (-(1.5 - f) * inv, -2.0 * (f - 1.0) * inv, (f - 0.5) * inv)
    offsets = (-f * spacing, (1.0 - f) * spacing, (2.0 - f) * spacing)
    return Stencil(base, weights, slopes, offsets)
