"""Checks of what a shape's ``distance`` returns, and of its derivatives."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.checks import check_numbers
from rewax.physics.shapes import Shape, signed_distance
from rewax.physics.shapes.base import require_shape
from rewax.physics.shapes.sizes import size_numbers
from rewax.testing.shape_points import Sample, at
from rewax.testing.traced import named
from rewax.types import Array

_STEP = 1e-6
"""Of finite differences, in sizes of the shape."""
_OFF = 1e-4
"""What finite differences in float64 may be off, relative."""
_KINKS = "use jnp.where, and safe_sqrt, safe_rsqrt and unit of rewax.physics.numerics.components for roots"


def check_protocol(shape: Any) -> None:
    """A decorated ``Shape`` whose sizes are declared and legal, and whose distance has the form that is asked for."""
    kind = type(shape).__name__
    try:
        require_shape(shape)
        check_numbers(size_numbers(shape, kind))
        jax.eval_shape(lambda: shape.distance((jnp.ones(5),) * 3))
    except ValueError as error:
        raise AssertionError(str(error)) from error
    declared = {number.name for number in size_numbers(shape, "")}
    for path, _ in jax.tree.leaves_with_path(shape):
        name = jax.tree_util.keystr(path)
        assert name in declared, (
            f"{kind}{name} does not say what it may be: declare it with struct.number(POSITIVE, "
            '"give a length in metres") or another range of rewax.physics.numerics.checks'
        )
    for form in ((5,), (2, 3), ()):
        p = (jnp.ones(form),) * 3
        found = named(f"distance of {kind}", jax.eval_shape, lambda shape, p: shape.distance(p), shape, p)
        legal = isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], tuple) and len(found[1]) == 3
        assert legal, f"distance of {kind} returns {found!r}: return distance, (normal_x, y, z)"
        shapes = [jnp.shape(a) for a in (found[0], *found[1])]
        assert all(s == form for s in shapes), (
            f"distance of {kind} returns arrays of shapes {shapes} for points of shape {form}: compute "
            "with the components p[0], p[1], p[2] alone, and give constants their shape with jnp.zeros_like(p[0])"
        )
    named(f"bounding_radius of {kind}", jax.eval_shape, lambda shape: shape.bounding_radius(), shape)
    if shape.is_bounded:
        named(f"volume of {kind}", jax.eval_shape, lambda shape: shape.volume(), shape)


def check_values(sample: Sample) -> None:
    """Finite everywhere, in the precision of the points; normals have unit length, or are zero where there is none."""
    points = np.concatenate([sample.random, sample.special, sample.surface])
    d, n = sample.distance(points)
    assert d.dtype == n.dtype == np.float64, (
        f"distance of {sample.name} returns {d.dtype} and {n.dtype} for points of float64: write Python numbers or "
        "jnp.zeros_like(p[0]), not arrays of a fixed type"
    )
    for what, wrong in (("distance", ~np.isfinite(d)), ("normal", ~np.isfinite(n).all(axis=1))):
        assert not wrong.any(), f"the {what} at {at(points[wrong][0])} is not finite: {_KINKS}"
    length = np.linalg.norm(n, axis=1)
    wrong = length > 1.0 + 1e-6
    wrong[: len(sample.random)] |= length[: len(sample.random)] < 1.0 - 1e-6
    assert not wrong.any(), (
        f"the normal at {at(points[wrong][0])} has length {length[wrong][0]:.6g}, but must have 1: divide it by its "
        "length (components.unit)"
    )
    assert (d < 0).any() and (d > 0).any(), (
        f"the distance is {'negative' if (d < 0).any() else 'positive'} at all of {len(d)} points: it must be negative "
        "inside and positive outside; give a region that the surface crosses if it is far from the origin"
    )


def check_normals(sample: Sample, tolerance: float) -> None:
    """The normal is the gradient of the distance, which is one per metre."""
    exact = sample.shape.is_exact
    points = sample.random
    gradient, is_smooth = _gradient(sample, points)
    share = is_smooth.mean()
    assert share > 0.9, (
        f"the distance jumps at {1 - share:.0%} of random points, at {at(points[~is_smooth][0])} for one: let it be "
        "continuous"
    )
    if not exact:
        nudge = 1e-4 * sample.size * sample.rng.uniform(-1.0, 1.0, (len(sample.surface), 3))
        points = sample.surface + nudge
        gradient, is_smooth = _gradient(sample, points)
    _, n = sample.distance(points)
    points, n, gradient = points[is_smooth], n[is_smooth], gradient[is_smooth]
    slope = np.linalg.norm(gradient, axis=1)
    off = _OFF if exact else tolerance
    along = np.sum(n * gradient, axis=1) / np.maximum(slope, 1e-30)
    assert np.mean(along < 0) < 0.5, (
        f"the normal at {at(points[along < 0][0])} points to the inside: give it the direction in which the distance "
        "grows"
    )
    wrong = np.linalg.norm(n - gradient / np.maximum(slope, 1e-30)[:, None], axis=1) > off
    assert not wrong.any(), (
        f"the normal at {at(points[wrong][0])} is {at(n[wrong][0])}, but the distance's gradient there is "
        f"{at(gradient[wrong][0])}: return the gradient, of unit length"
    )
    wrong = (np.abs(slope - 1.0) if exact else slope - 1.0) > off
    remedy = "or set is_exact = False if it is right near the surface only" if exact else "or give a larger tolerance"
    assert not wrong.any(), (
        f"at {at(points[wrong][0])} the distance changes by {slope[wrong][0]:.4g} per metre, but must change by "
        f"{'1' if exact else 'at most 1'}: divide it by that, {remedy}"
    )
    if exact:
        _check_feet(sample)


def _check_feet(sample: Sample) -> None:
    d, n = sample.distance(sample.random)
    left = np.abs(sample.distance(sample.random - d[:, None] * n)[0])
    wrong = left > 1e-5 * sample.size
    assert not wrong.any(), (
        f"{at(sample.random[wrong][0])} is said to be {d[wrong][0]:.4g} m from the surface, but that far along its "
        f"normal the distance is still {left[wrong][0]:.4g} m: give that to the nearest point, or set is_exact = False"
    )


def check_derivatives(sample: Sample) -> None:
    """Finite at all points, those of finite differences at random ones; each size has an effect."""
    points = np.concatenate([sample.random, sample.special, sample.surface])
    by_points, of_both, by_sizes = _reverse(sample, points)
    tangents = jax.tree.map(lambda a: sample.rng.uniform(0.5, 1.0, np.shape(a)), sample.exact)
    forward = _forward(sample, points, tangents)
    wrong = ~np.isfinite(by_points).all(axis=1)
    for leaf in (of_both, *forward):
        wrong |= ~np.isfinite(leaf.reshape(len(points), -1)).all(axis=1)
    assert not wrong.any(), f"a derivative of distance or normal at {at(points[wrong][0])} is not finite: {_KINKS}"
    for (path, leaf), size in zip(jax.tree.leaves_with_path(by_sizes), jax.tree.leaves(sample.exact), strict=True):
        name = sample.name + jax.tree_util.keystr(path)
        assert np.isfinite(leaf).all(), f"the derivative of distances with respect to {name} is not finite: {_KINKS}"
        _check_size(sample, name, path, float(np.max(np.abs(size))))
    gradient, is_smooth = _gradient(sample, sample.random)
    off = np.abs(by_points[: len(sample.random)] - gradient).max(axis=1)
    _check_most(sample, off[is_smooth], sample.random[is_smooth], "the derivative of the distance by the point")


def _check_size(sample: Sample, name: str, path: Any, magnitude: float) -> None:
    """The derivative of the distances with respect to one field, against a finite difference."""
    tangents = jax.tree_util.tree_map_with_path(
        lambda p, a: sample.rng.uniform(0.5, 1.0, np.shape(a)) * (p == path), sample.exact
    )
    step = _STEP * max(magnitude, 1e-3 * sample.size)
    with jax.enable_x64(True):
        moved = [jax.tree.map(lambda a, t, s=s: a + s * t, sample.exact, tangents) for s in (step, -step)]
    after, before = (sample.distance(sample.random, shape)[0] for shape in moved)
    found = _forward(sample, sample.random, tangents)[0]
    assert np.any(found != 0), (
        f"the distance does not depend on {name}: use it, cut no gradient, or make it a struct.static_field()"
    )
    off = np.abs(found - (after - before) / (2.0 * step)) / max(1.0, float(np.max(np.abs(found))))
    _check_most(sample, off, sample.random, f"the derivative of the distance by {name}")


def _check_most(sample: Sample, off: np.ndarray, points: np.ndarray, what: str) -> None:
    """Almost all: a finite difference across a kink is none."""
    wrong = off > 10.0 * _OFF
    assert wrong.mean() < 0.02, (
        f"{what} at {at(points[wrong][0])} differs from a finite difference by {off[wrong][0]:.2g}: let no "
        "stop_gradient, rounding or custom derivative of "
        f"{sample.name} change it"
    )


def _gradient(sample: Sample, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences of the distance, shape (num, 3), and where those of both sides agree, shape (num,)."""
    step = _STEP * sample.size
    middle = sample.distance(points)[0]
    sides = [(sample.distance(points + step * e)[0], sample.distance(points - step * e)[0]) for e in np.eye(3)]
    central = np.stack([(a - b) / (2.0 * step) for a, b in sides], axis=1)
    bends = np.stack([np.abs(a - 2.0 * middle + b) / step for a, b in sides], axis=1)
    return central, np.max(bends, axis=1) < 1e-3


def _reverse(sample: Sample, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, Any]:
    """Reverse derivatives: of distances by points, of distances and normals by points, and by sizes."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _pulled(sample.exact, jnp.asarray(points)))


def _forward(sample: Sample, points: np.ndarray, tangents: Any) -> tuple[np.ndarray, np.ndarray]:
    with jax.enable_x64(True):
        tangents = jax.tree.map(lambda t: jnp.asarray(t, float), tangents)
        d, n = _pushed(sample.exact, jnp.asarray(points), tangents)
        return np.asarray(d), np.asarray(n)


@jax.jit
def _pulled(shape: Shape, points: Array) -> tuple[Array, Array, Any]:
    (d, n), back = jax.vjp(signed_distance, shape, points)
    by_sizes, of_both = back((jnp.ones_like(d), jnp.ones_like(n)))
    return back((jnp.ones_like(d), jnp.zeros_like(n)))[1], of_both, by_sizes


@jax.jit
def _pushed(shape: Shape, points: Array, tangents: Any) -> tuple[Array, Array]:
    return jax.jvp(lambda shape: signed_distance(shape, points), (shape,), (tangents,))[1]


__all__ = ["check_derivatives", "check_normals", "check_protocol", "check_values"]
