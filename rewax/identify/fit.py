"""``identify``: the parameters with which an environment shows what a record shows."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.randomize import Draw
from rewax.identify import levenberg_marquardt as lm
from rewax.identify.evaluation import Evaluation, Residuals
from rewax.identify.record_checks import check_against, check_frame_weights, check_record, tool_remarks
from rewax.identify.records import Record
from rewax.identify.result import Identified
from rewax.identify.simulate import data_of, points_of, without_reset_noise
from rewax.identify.starts import REGIONS, placements_of, program, search_from, spread_starts
from rewax.identify.surface import particle_spacing
from rewax.identify.uncertainty import combined, posterior, short, undetermined
from rewax.identify.unknowns import Space, is_stable, space_of, stable_bounds
from rewax.status import FATAL, describe

_WIDTH = 0.5
"""Width of the surface's weights, in spacings of the particles."""
_AT_BOUND = 1e-3
"""Coordinates that are nearer to a bound of the search lie at it."""
_BEYOND = 2.0
"""How far beyond the priors grids are searched whose values are extrapolated, in standard deviations of the prior."""
_ONE_FIT = (
    "One fit counts for each environment, so intervals lack what the particles' placement does: give more starts."
)
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
    limit: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Identified:
    """Fit unknown parameters of an environment to a record, by Levenberg-Marquardt from several starts.

    The first start is the median of the priors, the others cover them. A horizon that grows keeps early fits away from
    local minima of long motions. Frames beyond it are not simulated; the compiled program is the same. The substep of
    the environment bounds how stiff a material can be. ``Identified.remarks`` says so if this ends a search. A
    simulation that fails is a rejected step and counted.

    Args:
      env: an environment, with ``particles(physics)``; its reset noise is left out. Or several of the same scene with
        different resolutions, the finest last: the starts are divided among them. The search begins with the first, and
        each of the others begins where the one before ended. The finest gives the result, and its difference from the
        others is part of the uncertainty.
      record: what was seen.
      unknowns: priors by the names of parameters, as ``rewax.envs.randomize.hook`` takes them: LogNormal, LogUniform,
        Normal or Uniform, or ``Scale`` or ``Shift`` of one. A tuple of names shares a number. For i from 0 to 2,
        ``initial.position[i]`` is a shift of the soft body in the first state [m], ``initial.velocity[i]`` its velocity
        [m/s].
      starts: number of starts.
      horizons: shares of the record's duration, rising, the last is 1.
      max_iterations: of the last horizon; the others have a third.
      noise: smallest standard deviation of a seen point [m].
      frame_weights: of the frames, shape (num_frames,); None: all 1.
      residuals: ``(particles, cloud, mask, offsets) -> residuals`` of a frame [m], shape (num_points,), with the
        ``surface_offsets`` of the first frame; None: ``surface_residuals``. Pass the same function again to use its
        compiled program again.
      width: of the surface's weights [m]; None: half of the particles' spacing.
      shake: each start displaces the rest positions at random by up to this share of their spacing along each axis,
        so that the scatter of the fits tells what the placement of particles does; 0: none. Vertices of meshes stay.
      seed: of the starts, their placements and the reset.
      side_by_side: starts that are computed at the same time; more need more memory.
      limit: with several environments of particles: spacing of the grid to which the result is extrapolated [m], along
        the line through the coarsest and the finest; 0: matter itself. The fits may then leave the priors by two
        standard deviations, because a grid moves what is found; the result does not. None: the result is that of the
        finest.
      progress: called with a line for each iteration.

    Returns:
      Values, covariance and intervals of the unknowns, and remarks about the search. Gradient: none.

    Raises:
      ValueError: a bad record, an unknown name or prior, an environment that is unstable at the median of the priors,
        or no start whose simulation is valid.
    """
    began = time.perf_counter()
    check_record(record)
    given = env if isinstance(env, (list, tuple)) else (env,)
    _check_options(starts, len(given), horizons, shake, frame_weights, record)
    _check_numbers(max_iterations=max_iterations, side_by_side=side_by_side, noise=noise, width=width)
    envs = [without_reset_noise(one) for one in given]
    first = np.asarray(points_of(envs[0], jax.jit(envs[0].reset)(jax.random.key(seed)).physics))
    check_against(record, envs[0], first)
    spacings = None if limit is None else _spacings(envs, limit)
    space = space_of(unknowns, envs[0])
    low, high, remarks = stable_bounds(space, envs, 0.0 if limit is None else _BEYOND)
    groups = _groups(starts, len(envs))
    stages = _stages(record, horizons, frame_weights, max_iterations)
    points, deviation, searches, histories = spread_starts(space, starts, low, high, seed), 0.0, [], []
    for i, one in enumerate(envs):
        spacing = particle_spacing(np.asarray(points_of(one, jax.jit(one.reset)(jax.random.key(seed)).physics)))
        data = data_of(record, _WIDTH * spacing if width is None else width, REGIONS, seed)
        placed = placements_of(one, starts, shake, spacing, seed)
        own = None if placed is None else placed[groups == i]
        search, history = search_from(
            points[groups == i], program(one, space, data, residuals, side_by_side, own),
            stages if i == 0 else stages[-1:], deviations=(deviation or max(noise, 0.1 * spacing), noise), space=space,
            bounds=(low, high), say=progress or (lambda line: None),
            stable=functools.partial(lambda env, p: is_stable(space.place(env, jnp.asarray(p))), one),
        )  # fmt: skip
        points, deviation = _end_of(search, space, noise)
        points = np.tile(points, (starts, 1))
        searches.append(search)
        histories.append(history)
    search, history = lm.joined(searches), np.concatenate(histories)
    total = search.total(space.precision)
    kept = _kept(total, groups)
    coarsest = search.latents[kept & (groups == groups[kept].min())].mean(0)
    ends = np.maximum(low, space.bounds[0]), np.minimum(high, space.bounds[1])
    latent, between = combined(
        search.latents[kept], groups[kept], spacings, 0.0 if limit is None else limit, _cut_off(coarsest, *ends)
    )
    latent = np.clip(latent, *space.bounds)
    finest = kept & (groups == groups[kept].max())
    found = Evaluation(*(np.asarray(a)[finest].mean(0) for a in search.evaluation))
    covariance = posterior(found.hessian, found.scores, between)
    remarks += tool_remarks(given[-1]) + _remarks(search, space, latent, kept, *ends)
    if kept.sum() == len(np.unique(groups[kept])):
        remarks.append(_ONE_FIT)
    remarks += cut_off(space, latent, covariance) + ([] if spacings is None else _halfway(space, coarsest, ends))
    return Identified(
        space=space, latent=latent, covariance=covariance, bounds=ends,
        undetermined=undetermined(space, covariance), times=np.asarray(record.times), env=given[-1],
        remarks=remarks, residual_by_frame=found.by_frame,
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


def _groups(starts: int, count: int) -> np.ndarray:
    """The environment of each start, shape (starts,): equal numbers, the first has the rest."""
    others = np.repeat(np.arange(1, count), starts // count)
    return np.concatenate([np.zeros(starts - len(others), int), others])


def _spacings(envs: Sequence[Any], limit: float) -> np.ndarray:
    """Spacings of the grids [m], shape (num_envs,), for an extrapolation to ``limit``."""
    grids = [getattr(getattr(getattr(env, "unwrapped", env), "scene", None), "grid", None) for env in envs]
    found = np.array([np.nan if grid is None else float(grid.spacing) for grid in grids])
    if len(found) < 2 or not (np.diff(found) < 0.0).all() or not 0.0 <= limit < found[-1]:
        raise ValueError(
            f"limit is {limit} with spacings of the grid of {', '.join(f'{s:.4g}' for s in found)} m: give at least "
            "two environments of particles, the finest last, and a limit from 0 to below its spacing"
        )
    return found


def _end_of(search: lm.Starts, space: Space, noise: float) -> tuple[np.ndarray, float]:
    """The mean of the starts that fit about equally well, and the standard deviation of their residuals [m]."""
    if not search.evaluation.ok.any():
        bits = int(np.bitwise_or.reduce(search.evaluation.status))
        raise ValueError(f"no start has a valid simulation, status {describe(bits)}: give priors of softer materials")
    kept = _kept(search.total(space.precision), np.zeros(len(search.latents), int))
    return search.latents[kept].mean(0), max(noise, float(search.evaluation.spread[kept].mean()))


def _kept(total: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Which starts reached about the lowest cost of their environment, shape (S,), bool."""
    lowest = np.array([total[groups == g].min() for g in groups])
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
    check_frame_weights(weights, record.num_frames)
    if weights is not None and not np.any(weights[1:]):
        raise ValueError(
            f"frame_weights is {weights!r}: give one above 0 after the first, because the first frame only fixes the "
            "surface"
        )


def _check_numbers(*, max_iterations: int, side_by_side: int, noise: float, width: float | None) -> None:
    for name, count in (("max_iterations", max_iterations), ("side_by_side", side_by_side)):
        if count < 1:
            raise ValueError(f"{name} is {count}: give at least 1")
    for name, length in (("noise", noise), ("width", width)):
        if length is not None and not 0.0 < length < np.inf:
            raise ValueError(f"{name} is {length}: give a length in metres, above 0")


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
        if _cut_off(latent, low, high)[i]:
            said.append(f"{short(label)} lies at a bound of the search: widen its prior, or doubt the model.")
    if search.active.any():
        said.append(f"{int(search.active.sum())} of {len(search.active)} starts had not converged.")
    return said


def _cut_off(latent: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which coordinates lie at a bound or beyond, shape (k,), bool."""
    return np.minimum(latent - low, high - latent) < _AT_BOUND


def _halfway(space: Space, coarsest: np.ndarray, ends: tuple[np.ndarray, np.ndarray]) -> list[str]:
    def sentence(label: str, outside: bool) -> str:
        where, remedy = "reaches the end of the stable range", "give a larger num_substeps"
        if outside:
            where, remedy = "leaves its prior", "widen its prior"
        return (
            f"{short(label)} {where} on the coarsest grid, so the value lies halfway between that of the finest grid "
            f"and the extrapolated one: fit on finer grids, or {remedy}."
        )

    outside, at = _cut_off(coarsest, *space.bounds), _cut_off(coarsest, *ends)
    return [sentence(label, bool(outside[i])) for i, label in enumerate(space.labels) if at[i]]


def cut_off(space: Space, latent: np.ndarray, covariance: np.ndarray) -> list[str]:
    """Sentences about unknowns whose 95 % interval is cut off at an end of the prior."""
    reach = 1.96 * np.sqrt(np.diag(covariance))
    low, high = space.bounds
    ends = np.where(latent - reach < low, "lower", np.where(latent + reach > high, "upper", ""))
    both = (latent - reach < low) & (latent + reach > high)
    return [
        f"The interval of {short(label)} ends at {'both ends' if two else f'the {end} end'} of its prior: a wider "
        "prior gives a wider interval."
        for label, end, two in zip(space.labels, ends, both, strict=True)
        if end
    ]


__all__ = ["cut_off", "identify"]
