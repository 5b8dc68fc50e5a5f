"""Checks of ``distance`` of a shape: its values are finite, and the normal is the gradient of the distance."""

import numpy as np

from rewax.testing.shape_points import Sample, at

STEP = 1e-6
"""Step of finite differences, relative to the size of the shape."""
OFF = 1e-4
"""Largest relative error of finite differences in float64."""
_FEWEST = 100
"""Smallest number of points on the surface."""
KINKS = "use jnp.where, and safe_sqrt, safe_rsqrt and unit of rewax.physics.numerics.components for roots"


def check_values(sample: Sample) -> None:
    """Checks that values are finite, in float64, and that normals have length 1, or 0 where there is no normal."""
    points = np.concatenate([sample.random, sample.special, sample.surface])
    d, n = sample.distance(points)
    assert d.dtype == n.dtype == np.float64, (
        f"distance of {sample.name} returns {d.dtype} and {n.dtype} for points of float64: write Python numbers or "
        "jnp.zeros_like(p[0]), not arrays of a fixed type"
    )
    for what, wrong in (("distance", ~np.isfinite(d)), ("normal", ~np.isfinite(n).all(axis=1))):
        assert not wrong.any(), f"the {what} at {at(points[wrong][0])} is not finite: {KINKS}"
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
    """Checks that the normal is the gradient of the distance, and that the gradient has length 1."""
    exact = sample.shape.is_exact
    points = sample.random
    gradient, is_smooth = gradient_by_differences(sample, points)
    share = is_smooth.mean()
    assert share > 0.9, (
        f"the distance jumps at {1 - share:.0%} of random points, at {at(points[~is_smooth][0])} for one: let it be "
        "continuous"
    )
    if not exact:
        assert len(sample.surface) >= _FEWEST, (
            f"twenty steps of the distance along the normal lead from {len(sample.surface)} of {len(points)} random "
            f"points to the surface of {sample.name}: let the distance change by nearly 1 per metre near the surface"
        )
        nudge = 1e-4 * sample.size * sample.rng.uniform(-1.0, 1.0, (len(sample.surface), 3))
        points = sample.surface + nudge
        gradient, is_smooth = gradient_by_differences(sample, points)
    _, n = sample.distance(points)
    points, n, gradient = points[is_smooth], n[is_smooth], gradient[is_smooth]
    slope = np.linalg.norm(gradient, axis=1)
    off = OFF if exact else tolerance
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


def gradient_by_differences(sample: Sample, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences of the distance, shape (num, 3), and whether one-sided differences agree, shape (num,)."""
    step = STEP * sample.size
    middle = sample.distance(points)[0]
    sides = [(sample.distance(points + step * e)[0], sample.distance(points - step * e)[0]) for e in np.eye(3)]
    central = np.stack([(a - b) / (2.0 * step) for a, b in sides], axis=1)
    bends = np.stack([np.abs(a - 2.0 * middle + b) / step for a, b in sides], axis=1)
    return central, np.max(bends, axis=1) < 1e-3


__all__ = ["KINKS", "OFF", "STEP", "check_normals", "check_values", "gradient_by_differences"]
