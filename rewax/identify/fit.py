"""``identify``: the parameters with which an environment shows what a record shows."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.randomize import Draw
from rewax.identify import levenberg_marquardt as lm
from rewax.identify.evaluation import Evaluation, Residuals
from rewax.identify.record_checks import check_against, check_record
from rewax.identify.records import Record
from rewax.identify.result import Identified
from rewax.identify.simulate import data_of, points_of, without_reset_noise
from rewax.identify.starts import REGIONS, placements_of, program, search_from, spread_starts
from rewax.identify.surface import particle_spacing
from rewax.identify.uncertainty import combined, posterior, short, undetermined
from rewax.identify.unknowns import Space, is_stable, space_of, stable_bounds
from rewax.status import FATAL, describe

_WIDTH = 0.5
"""Of the weights of the surface, in spacings of the particles."""
_ALIKE = 1.0
"""Starts whose cost exceeds the lowest by less than this share count for the result. Costs differ by placement, too."""


def identify(
    env: Any,
    record: Record,
    unknowns: Mapping[Any, Draw],
    *,
    starts: int = 6,
    horizons: Sequence[float] = (0.5, 1.0),
    max_iterations: int = 12,
    noise: float = 0.002,
    frame_weights: np.ndarray | None = None,
    residuals: Residuals | None = None,
    width: float | None = None,
    shake: float = 0.4,
    seed: int = 0,
    side_by_side: int = 2,
    progress: Callable[[str], None] | None = None,
) -> Identified:
    """Fit unknown parameters of an environment to a record, by Levenberg-Marquardt from several starts.

    The first start is the median of the priors, the others cover them. A horizon that grows keeps early fits
    away from local minima of long motions: frames beyond it have weight zero, in the same compiled program. The substep
    of the environment bounds how stiff a material can be; a search that it cuts off says so. A simulation that fails is
    a rejected step and counted.

    Args:
      env: an environment, with ``particles(physics)``; its reset noise is left out. Or several of the same scene with
        different resolutions, the finest last: the starts are divided among them. The finest gives the result, and its
        difference from the others is part of the uncertainty.
      record: what was seen.
      unknowns: priors by the names of parameters, see ``unknowns.space_of``.
      starts: number of starts.
      horizons: shares of the record's duration, rising, the last is 1.
      max_iterations: of the last horizon; the others have a third.
      noise: smallest standard deviation of a seen point [m].
      frame_weights: of the frames, shape (num_frames,); None: all 1.
      residuals: of a frame [m], see ``evaluation.Residuals``; None: distances to the surface of the particles. Pass the
        same function again to use its compiled program again.
      width: of the surface's weights [m]; None: half of the particles' spacing.
      shake: each start displaces the rest positions at random by up to this share of their spacing along each axis,
        so that the scatter of the fits tells what the placement of particles does; 0: none.
      seed: of the starts, their placements and the reset.
      side_by_side: starts that one program computes; more need more memory.
      progress: called with a line for each iteration.

    Raises:
      ValueError: in one sentence: a bad record, an unknown name or prior, an environment that is unstable at the
        median of the priors, or no start whose simulation is valid.
    """
    began = time.perf_counter()
    check_record(record)
    given = env if isinstance(env, (list, tuple)) else (env,)
    _check_options(starts, len(given), horizons, shake, frame_weights, record)
    envs = [without_reset_noise(one) for one in given]
    env = envs[0]
    first = np.asarray(points_of(env, jax.jit(env.reset)(jax.random.key(seed)).physics))
    check_against(record, env, first)
    space = space_of(unknowns, env)
    low, high, remarks = stable_bounds(space, envs)
    spacing = particle_spacing(first)
    data = data_of(record, _WIDTH * spacing if width is None else width, REGIONS, seed)
    placed = [placements_of(one, starts, shake, spacing, seed) for one in envs]
    search, history = search_from(
        spread_starts(space, starts, low, high, seed), program(envs, space, data, residuals, side_by_side, placed),
        _stages(record, horizons, frame_weights, max_iterations), deviations=(max(noise, 0.1 * spacing), noise),
        space=space, bounds=(low, high), say=progress or (lambda line: None),
        stable=lambda p: all(is_stable(space.place(one, jnp.asarray(p))) for one in envs),
    )  # fmt: skip
    if not search.evaluation.ok.any():
        bits = int(np.bitwise_or.reduce(search.evaluation.status))
        raise ValueError(f"no start has a valid simulation, status {describe(bits)}: give priors of softer materials")
    total = search.total(space.precision)
    kept = _kept(total, len(envs))
    groups = np.arange(starts) % len(envs)
    latent, between = combined(search.latents[kept], groups[kept])
    finest = kept & (groups == groups[kept].max())
    found = Evaluation(*(np.asarray(a)[finest].mean(0) for a in search.evaluation))
    covariance = posterior(found.hessian, found.scores, between)
    return Identified(
        space=space, latent=latent, covariance=covariance, bounds=(low, high),
        undetermined=undetermined(space, covariance), times=np.asarray(record.times), env=given[-1],
        remarks=remarks + _remarks(search, space, latent, kept, low, high), residual_by_frame=found.by_frame,
        starts=search.latents, costs=total, history=history, failed=int(search.rejected.sum()),
        seconds=time.perf_counter() - began,
    )  # fmt: skip


def _stages(
    record: Record, horizons: Sequence[float], frame_weights: Any, iterations: int
) -> list[tuple[float, np.ndarray, int]]:
    """For each horizon its share, the weights of the frames and the largest number of iterations.

    The first frame fixes the surface and depends on no material: it has weight 0.
    """
    base = np.ones(record.num_frames) if frame_weights is None else np.array(frame_weights, float)
    base[0] = 0.0
    times = np.asarray(record.times)
    every = [(h, np.where(times <= h * times[-1] + 1e-9, base, 0.0)) for h in horizons]
    return [(h, w, iterations if h == 1.0 else max(2, iterations // 3)) for h, w in every if w.any() or h == 1.0]


def _kept(total: np.ndarray, count: int) -> np.ndarray:
    """Which starts reached about the lowest cost of their environment, shape (S,), bool."""
    lowest = np.array([total[i::count].min() for i in range(count)])[np.arange(len(total)) % count]
    return np.isfinite(total) & (total <= lowest * (1.0 + _ALIKE))


def _check_options(
    starts: int, num_envs: int, horizons: Sequence[float], shake: float, weights: Any, record: Record
) -> None:
    if starts < num_envs:
        raise ValueError(f"starts is {starts} with {num_envs} environments: give at least one for each")
    if not horizons or list(horizons) != sorted(horizons) or horizons[-1] != 1.0 or horizons[0] <= 0.0:
        raise ValueError(f"horizons is {tuple(horizons)}: give rising shares above 0 that end with 1")
    if not 0.0 <= shake < 1.0:
        raise ValueError(f"shake is {shake}: give a share of the spacing in [0, 1)")
    if weights is not None and (
        np.shape(weights) != (record.num_frames,) or np.min(weights) < 0 or not np.any(weights)
    ):
        raise ValueError(f"frame_weights is {weights!r}: give {record.num_frames} numbers of at least 0, not all 0")


def _remarks(
    search: lm.Starts, space: Space, latent: np.ndarray, kept: np.ndarray, low: np.ndarray, high: np.ndarray
) -> list[str]:
    said = []
    if search.rejected.sum():
        said.append(f"{int(search.rejected.sum())} simulations failed and were rejected.")
    if not kept.all():
        said.append(f"{int(kept.sum())} of {len(kept)} starts fit about equally well; the others are left out.")
    bits = int(np.bitwise_or.reduce(search.evaluation.status[kept])) & ~int(FATAL)
    if bits:
        said.append(f"The best simulations have status {describe(bits)}, so their numbers are less reliable.")
    for i, label in enumerate(space.labels):
        if min(latent[i] - low[i], high[i] - latent[i]) < 1e-3:
            said.append(f"{short(label)} lies at a bound of the search: widen its prior, or doubt the model.")
    if search.active.any():
        said.append(f"{int(search.active.sum())} of {len(search.active)} starts had not converged.")
    return said


__all__ = ["identify"]
