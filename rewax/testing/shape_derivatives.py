"""Checks of the derivatives of a shape's distance and normal."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.shapes import Shape, signed_distance
from rewax.testing.shape_distance import KINKS, OFF, STEP, gradient_by_differences
from rewax.testing.shape_points import Sample, at
from rewax.types import Array


def check_derivatives(sample: Sample) -> None:
    """Checks that derivatives are finite and agree with finite differences; the distance must depend on each size."""
    points = np.concatenate([sample.random, sample.special, sample.surface])
    by_points, of_both, by_sizes = _reverse(sample, points)
    still, moves = jax.tree.map(np.zeros_like, sample.exact), np.zeros_like(sample.random)
    ones = jax.tree.map(np.ones_like, sample.exact)
    wrong = ~np.isfinite(by_points).all(axis=1)
    for found in (of_both, *_forward(sample, points, ones, np.ones_like(points))):
        wrong |= ~np.isfinite(found.reshape(len(points), -1)).all(axis=1)
    assert not wrong.any(), f"a derivative of distance or normal at {at(points[wrong][0])} is not finite: {KINKS}"
    for (path, leaf), size in zip(jax.tree.leaves_with_path(by_sizes), jax.tree.leaves(sample.exact), strict=True):
        name = sample.name + jax.tree_util.keystr(path)
        assert np.isfinite(leaf).all(), f"the derivative of distances with respect to {name} is not finite: {KINKS}"
        grows = jax.tree_util.tree_map_with_path(
            lambda p, a, path=path: sample.rng.uniform(0.5, 1.0, np.shape(a)) * (p == path), sample.exact
        )
        assert np.any(_forward(sample, sample.random, grows, moves)[0] != 0), (
            f"the distance does not depend on {name}: use it, cut no gradient, or make it a struct.static_field()"
        )
        _check_along(sample, name, grows, moves, STEP * max(float(np.max(np.abs(size))), 1e-3 * sample.size))
    moves = sample.rng.uniform(-1.0, 1.0, moves.shape)
    _check_along(sample, "the point", still, moves, STEP * sample.size)
    gradient, is_smooth = gradient_by_differences(sample, sample.random)
    off = np.abs(by_points[: len(sample.random)] - gradient).max(axis=1)
    _check_most(sample, off[is_smooth], sample.random[is_smooth], "the reverse derivative of the distance by position")


def _check_along(sample: Sample, name: str, grows: Any, moves: np.ndarray, step: float) -> None:
    """Checks forward derivatives of distance and normal along a direction of sizes and points."""
    with jax.enable_x64(True):
        shapes = [jax.tree.map(lambda a, t, s=s: a + s * t, sample.exact, grows) for s in (step, -step)]
    after, before = (
        sample.distance(sample.random + s * moves, shape) for s, shape in zip((step, -step), shapes, strict=True)
    )
    found = _forward(sample, sample.random, grows, moves)
    for what, scale, rate, a, b in zip(
        ("distance", "normal"), (1.0, 1.0 / sample.size), found, after, before, strict=True
    ):
        rate, difference = (x.reshape(len(moves), -1) for x in (rate, (a - b) / (2.0 * step)))
        off = np.max(np.abs(rate - difference) / np.maximum(scale, np.abs(rate)), axis=1)
        _check_most(sample, off, sample.random, f"the derivative of the {what} by {name}")


def _check_most(sample: Sample, off: np.ndarray, points: np.ndarray, what: str) -> None:
    """Checks all points but 2 %: a finite difference across a kink is not the derivative."""
    wrong = off > 10.0 * OFF
    assert wrong.mean() < 0.02, (
        f"{what} at {at(points[wrong][0])} differs from a finite difference by {off[wrong][0]:.2g} (relative): remove "
        f"every stop_gradient, rounding and custom derivative of {sample.name} that changes it"
    )


def _reverse(sample: Sample, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, Any]:
    """Reverse derivatives of distances with respect to points, and of distances and normals to points and sizes."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _pulled(sample.exact, jnp.asarray(points)))


def _forward(sample: Sample, points: np.ndarray, grows: Any, moves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forward derivatives of distances and normals along a direction of sizes and points."""
    with jax.enable_x64(True):
        grows = jax.tree.map(lambda t: jnp.asarray(t, float), grows)
        return jax.tree.map(np.asarray, _pushed(sample.exact, jnp.asarray(points), grows, jnp.asarray(moves)))


@jax.jit
def _pulled(shape: Shape, points: Array) -> tuple[Array, Array, Any]:
    (d, n), back = jax.vjp(signed_distance, shape, points)
    by_sizes, of_both = back((jnp.ones_like(d), jnp.ones_like(n)))
    return back((jnp.ones_like(d), jnp.zeros_like(n)))[1], of_both, by_sizes


@jax.jit
def _pushed(shape: Shape, points: Array, grows: Any, moves: Array) -> tuple[Array, Array]:
    return jax.jvp(signed_distance, (shape, points), (grows, moves))[1]


__all__ = ["check_derivatives"]
