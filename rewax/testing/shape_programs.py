"""Checks that ``jit``, ``vmap`` and lowering to C++ give the same numbers."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering import LoweringWarning, pointwise, recorded
from rewax.physics.numerics import components as cp
from rewax.physics.shapes import Shape, signed_distance
from rewax.testing.shape_points import NUM, Sample
from rewax.types import Array

_OFF = 1e-4
"""Largest change by rounding in float32, relative to the largest number of an array."""


def check_programs(sample: Sample) -> list[str]:
    """Checks that distances, normals and derivatives are the same under ``jit``, ``vmap`` and in C++.

    Returns:
      A message for each reason why a program runs in XLA, slower than in C++.
    """
    points = jnp.asarray(sample.random[:NUM], jnp.float32)
    eager = signed_distance(sample.shape, points)
    _check_same(sample, "jit", jax.jit(signed_distance)(sample.shape, points), eager)
    sizes = [sample.shape, jax.tree.map(lambda a: 0.97 * a, sample.shape)]
    batch = jax.vmap(signed_distance)(jax.tree.map(lambda *a: jnp.stack(a), *sizes), jnp.stack([points, points]))
    for i, shape in enumerate(sizes):
        one = jax.tree.map(lambda a, i=i: a[i], batch)
        _check_same(sample, "vmap over sizes", one, signed_distance(shape, points))
    args = sample.shape, cp.split_vector(points)
    with recorded() as decisions, warnings.catch_warnings():
        warnings.simplefilter("ignore", LoweringWarning)
        lowered = jax.jit(_derivatives(pointwise(_distance)))(*args)
    _check_same(sample, "lowering to C++", lowered, jax.jit(_derivatives(_distance))(*args))
    reasons = sorted({decision.reason for decision in decisions if decision.reason})
    return [f"it runs in XLA, slower than in C++: {reason} (docs/lowering.md)" for reason in reasons]


def _distance(shape: Shape, p: cp.Vec3) -> tuple[Array, cp.Vec3]:
    return shape.distance(p)


def _derivatives(function: Any) -> Any:
    """A function that returns value, forward and reverse derivative of a function of shape and points."""

    def all_of_them(shape: Shape, p: cp.Vec3) -> tuple[Any, Any, Any]:
        value, back = jax.vjp(function, shape, p)
        forward = jax.jvp(function, (shape, p), jax.tree.map(jnp.ones_like, (shape, p)))[1]
        by_sizes, by_points = back(jax.tree.map(jnp.ones_like, value))
        return value, forward, (by_points, jax.tree.map(lambda a: a / NUM, by_sizes))

    return all_of_them


def _check_same(sample: Sample, what: str, found: Any, expected: Any) -> None:
    """Checks all numbers but 1 %: at a kink, rounding decides which of two normals is taken."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        finite = np.isfinite(b)
        with np.errstate(invalid="ignore"):  # inf - inf
            near = np.abs(a - b) <= _OFF * np.max(np.abs(b[finite]), initial=1e-30)  # false for NaN
        off = ~np.where(finite, near, (a == b) | (np.isnan(a) & np.isnan(b)))
        assert off.mean() < 0.01, (
            f"{what} changes numbers of distance of {sample.name}, {b[off][0]:.6g} to {a[off][0]:.6g}: let them depend "
            "on points and sizes alone, no Python state, no values known at compile time"
        )


__all__ = ["check_programs"]
