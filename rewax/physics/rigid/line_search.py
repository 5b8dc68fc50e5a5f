"""Constraint rows, and the exact line search of their solver."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call, no_transpose
from rewax.types import Array


class Rows(NamedTuple):
    """Constraints, one per row."""

    jacobian: Array
    """J, shape (num_rows, num_dofs)."""
    stiffness: Array
    """D > 0: force per unit of J a - a_ref, shape (num_rows,)."""
    target: Array
    """a_ref: acceleration at which the force is zero, shape (num_rows,)."""
    lower: Array
    """Smallest force, or -inf, shape (num_rows,)."""
    upper: Array
    """Largest force, or inf, shape (num_rows,)."""


def clipped_forces(rows: Rows, missed: Array) -> Array:
    """Forces where rows miss their targets by J a - a_ref, shape (num_rows,) each."""
    return jnp.clip(-rows.stiffness * missed, rows.lower, rows.upper)


def side_of(rows: Rows, missed: Array) -> Array:
    """0 for rows with unclipped force, -1 and 1 for rows at their lower and upper bound."""
    force = -rows.stiffness * missed
    return jnp.where(force <= rows.lower, -1, jnp.where(force >= rows.upper, 1, 0))


def exact_line_search(rows: Rows, missed: Array, change: Array, slope: Array, curve: Array, num_bounded: int) -> Array:
    """Step length at which the cost along a direction is least, shape ().

    Args:
      rows: the constraints.
      missed: J a - a_ref, shape (num_rows,).
      change: J times the direction, the change of ``missed`` per unit of length, shape (num_rows,).
      slope: derivative of the whole cost at length 0, negative.
      curve: curvature of the cost without the constraints.
      num_bounded: number of leading rows that can have a finite upper bound.

    The derivative is piecewise linear and increasing, with kinks where a row begins or ceases to be clipped.
    """
    residuals = (*rows[1:], missed, change, slope, curve)
    return linear_call(_LINE_SEARCH, no_transpose, num_bounded, residuals, (), like=(slope,))[0]


class _Line(NamedTuple):
    """The cost along a direction; ``rows`` has no Jacobian."""

    rows: Rows
    missed: Array
    change: Array
    slope: Array
    curve: Array

    def derivative(self, length: Array) -> Array:
        """The cost's derivative at a length, shape ()."""
        change = clipped_forces(self.rows, self.missed + length * self.change) - clipped_forces(self.rows, self.missed)
        return self.slope + length * self.curve - jnp.sum(self.change * change)

    def steepness(self, side: Array) -> Array:
        """The derivative's slope, of a piece in which the rows have these sides."""
        steepness = self.curve + jnp.sum(jnp.where(side == 0, self.rows.stiffness * self.change * self.change, 0.0))
        return jnp.where(steepness > 0, steepness, 1.0)  # zero for a direction of zero: already at the minimum


def _line(residuals: Arrays) -> _Line:
    return _Line(Rows(residuals[0][..., None], *residuals[:4]), *residuals[4:])


def _at_all_kinks(num_bounded: int, residuals: Arrays, linear: Arrays) -> Arrays:
    """Evaluates the derivative at all kinks. Between the last negative value and the next one it is linear."""
    if residuals[-1].ndim:  # a batch
        return jax.vmap(lambda *one: _at_all_kinks(num_bounded, one, linear))(*residuals)
    line = _line(residuals)
    rows, missed, change = line.rows, line.missed, line.change

    def kinks(bound: Array) -> Array:
        count = len(bound)
        finite = (change[:count] != 0) & jnp.isfinite(bound)
        at = -jnp.where(finite, bound, 0.0) / rows.stiffness[:count] - missed[:count]
        return jnp.maximum(jnp.where(finite, at / jnp.where(finite, change[:count], 1.0), 0.0), 0.0)

    lengths = jnp.concatenate([kinks(rows.lower), kinks(rows.upper[:num_bounded])])
    rising = jax.vmap(line.derivative)(lengths) > 0
    low = jnp.max(jnp.where(rising, 0.0, lengths))
    high = jnp.min(jnp.where(rising, lengths, jnp.inf))
    inside = jnp.where(jnp.isfinite(high), 0.5 * (low + high), low + 1.0)
    steepness = line.steepness(side_of(rows, missed + inside * change))
    return (jnp.clip(low - line.derivative(low) / steepness, low, high),)


def _piece_by_piece(num_bounded: int, residuals: Arrays, linear: Arrays) -> Arrays:
    """Newton's method between bounds: the root of a linear piece that contains it is exact.

    Where lengths outside of the bounds would follow, the middle does. Most searches take one or two evaluations.
    """
    del num_bounded, linear
    line = _line(residuals)
    eps = jnp.finfo(line.missed.dtype).eps

    class Search(NamedTuple):
        length: Array
        low: Array
        high: Array
        turns: Array
        done: Array

    def step(at: Search) -> Search:
        side = side_of(line.rows, line.missed + at.length * line.change)
        derivative = line.derivative(at.length)
        low = jnp.where(derivative < 0, at.length, at.low)
        high = jnp.where(derivative < 0, at.high, at.length)
        root = at.length - derivative / line.steepness(side)
        same = jnp.all(side_of(line.rows, line.missed + root * line.change) == side)
        middle = jnp.where(jnp.isfinite(high), 0.5 * (low + high), 2.0 * low + 1.0)
        following = jnp.where(same | ((low < root) & (root < high)), root, middle)
        narrow = jnp.abs(following - at.length) <= 4 * eps * jnp.abs(following)
        return Search(following, low, high, at.turns + 1, same | narrow)

    begin = jnp.zeros_like(line.slope)
    search = Search(begin + 1.0, begin, begin + jnp.inf, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    search = jax.lax.while_loop(lambda at: ~at.done & (at.turns < _MOST_TURNS), step, search)
    return (jnp.where(line.slope < 0, search.length, 0.0),)


_MOST_TURNS = 100
"""Of ``_piece_by_piece``; halving alone reaches rounding error in as many."""
_LINE_SEARCH = ByPlatform(cpu=_at_all_kinks, other=_at_all_kinks, scalar=_piece_by_piece)


__all__ = ["Rows", "clipped_forces", "exact_line_search", "side_of"]
