"""Checks of ``cast``: where rays enter a shape."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.testing.shape_points import Sample, at

_NUM = 512
_STEPS = 64
"""Number of points on each ray that are looked at."""
_MISSED = 5e-3
"""Share of rays that may enter too late: sphere tracing gives up on rays that graze the surface for long."""
_SLACK = 5e-3
"""Error of an entry, and depth below which a solid may be missed, relative to the longest edge of the box."""


def check_rays(sample: Sample) -> None:
    """Checks rays from outside, through points inside and past the solid, against the distance along them.

    Rays from inside must miss.
    """
    origins, directions, targets = _rays(sample)
    found = _cast(sample, origins, directions)
    advice = f"correct cast of {sample.name}, or leave the method out"
    legal = found >= 0
    assert legal.all(), (
        f"cast of {sample.name} returns {at(found[~legal][:3])}: give distances >= 0, infinite where a ray misses"
    )
    slack, lengths = _SLACK * sample.size, np.linalg.norm(directions, axis=1)
    hit = np.isfinite(found)
    assert np.allclose(_cast(sample, origins, 3.0 * directions)[hit] * 3.0, found[hit], atol=slack), (
        "a direction that is three times as long does not give a third of the distance: count in units of its length, "
        f"in cast of {sample.name}"
    )

    ends = origins + np.where(hit, found, 0.0)[:, None] * directions
    depths = np.where(hit, np.abs(sample.distance(ends)[0]), 0.0)
    worst = depths.argmax()
    assert depths[worst] <= slack, (
        f"a ray from {at(origins[worst])} enters {sample.name} at {at(ends[worst])}, by its cast, but there the "
        f"distance to the surface is {depths[worst]:.3g} m: {advice}"
    )

    # Where a ray hits, all before the entry is outside. Where it misses, all up to twice the target is.
    lasts = np.where(hit, np.maximum(found - slack / lengths, 0.0), 2.0)
    shares = np.linspace(0.0, 1.0, _STEPS)
    along = origins[:, None] + (shares * lasts[:, None])[..., None] * directions[:, None]
    inside = sample.distance(along.reshape(-1, 3))[0].reshape(along.shape[:2]).min(axis=1) < -slack
    assert inside.mean() <= _MISSED, (
        f"a ray from {at(origins[inside][0])} through {at(targets[inside][0])} enters {sample.name} earlier than its "
        f"cast says ({found[inside][0]:.4g} of the way): {advice}"
    )

    begins = targets[sample.distance(targets)[0] < -slack]
    sees = np.isfinite(_cast(sample, begins, directions[: len(begins)]))
    assert not sees.any(), (
        f"a ray from {at(begins[sees][:1].ravel())}, inside of {sample.name}, meets its surface, by its cast: return "
        "infinity where a ray begins inside, or leave the method out"
    )


def _rays(sample: Sample) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins outside, directions that reach their target at distance 1, and targets in and around the box."""
    points, inside = sample.inside
    solid = points[inside]
    aimed = solid[sample.rng.integers(len(solid), size=_NUM)] if len(solid) else points[:0]
    targets = np.concatenate([aimed, points[sample.rng.integers(len(points), size=_NUM)]])
    middle = 0.5 * (sample.lower + sample.upper)
    origins = sample.rng.normal(size=targets.shape)
    origins *= sample.size * sample.rng.uniform(0.5, 3.0, (len(targets), 1)) / np.linalg.norm(origins, axis=1)[:, None]
    origins += middle
    outside = sample.distance(origins)[0] > 0
    return origins[outside], (targets - origins)[outside], targets[outside]


def _cast(sample: Sample, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        rays = (tuple(jnp.asarray(points[:, i]) for i in range(3)) for points in (origins, directions))
        return np.asarray(sample.exact.cast(*rays))


__all__ = ["check_rays"]
