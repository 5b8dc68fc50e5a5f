"""Several starts of a search: where they begin, the placement of their particles, their program, their way."""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.leaves import EnvLeaves
from rewax.identify import levenberg_marquardt as lm
from rewax.identify.evaluation import Evaluation, Residuals, evaluate
from rewax.identify.simulate import Data, up_to
from rewax.identify.uncertainty import short
from rewax.identify.unknowns import Space
from rewax.physics.coupling.mixed import MixedScene
from rewax.physics.tets import TetScene
from rewax.physics.thin import ThinScene

REGIONS = 4
"""Regions along each of two axes, see ``simulate.regions``."""


def search_from(
    points: np.ndarray,
    run: Callable[..., Evaluation],
    stages: Sequence[tuple[float, np.ndarray, int]],
    *,
    deviations: tuple[float, float],
    space: Space,
    bounds: tuple[np.ndarray, np.ndarray],
    stable: Callable[[np.ndarray], bool],
    say: Callable[[str], None],
) -> tuple[lm.Starts, np.ndarray]:
    """The search over horizons that grow.

    Args:
      points: where the starts begin, shape (S, k).
      run: of ``program``.
      stages: for each horizon its share, the weights of the frames and the largest number of iterations.
      deviations: standard deviation of a residual to begin with, and the smallest one [m]; a stage takes that of the
        residuals of the one before.
      space, bounds, stable, say: see ``identify``.

    Returns:
      The starts, and the best values by iteration, shape (iterations, k).
    """
    deviation, least = deviations
    rejected, history = np.zeros(len(points), int), []
    starts = None
    for horizon, weights, iterations in stages:
        points = points if starts is None else starts.latents
        evaluate_some = functools.partial(run, horizon=horizon, weights=weights, deviation=deviation)
        starts = lm.begin(points, evaluate_some(points), rejected)
        for iteration in range(iterations):
            starts = lm.iterate(starts, evaluate_some, precision=space.precision, bounds=bounds, is_stable=stable)
            best = starts.best(space.precision)
            history.append([float(v) for v in space.numbers(starts.latents[best])])
            say(_line(space, starts, best, horizon, iteration))
            if not starts.active.any():
                break
        rejected, best = starts.rejected, starts.best(space.precision)
        if starts.evaluation.ok[best]:
            deviation = max(least, float(starts.evaluation.spread[best]))
    assert starts is not None
    return starts, np.asarray(history)


def program(
    env: Any, space: Space, data: Data, residuals: Residuals | None, side_by_side: int, placed: np.ndarray | None
) -> Callable[..., Evaluation]:
    """``evaluate`` of points, which of them are needed, horizon, weights and deviation, as arrays of NumPy.

    On a CPU each point is a call of its own, and ``side_by_side`` threads make them: that keeps more cores busy than a
    batch, and computes no point that nobody needs. Elsewhere points are computed in batches of ``side_by_side``,
    always as many, so that there is one program.
    """
    leaves = EnvLeaves.of(env)
    on_cpu = jax.default_backend() == "cpu"
    size, threads = (1, side_by_side) if on_cpu else (side_by_side, 1)

    def some(chosen: np.ndarray, latents: np.ndarray, at: Data, weights: np.ndarray, deviation: float) -> Evaluation:
        full = np.resize(chosen, size)  # repeats points where there are too few
        rest = None if placed is None else jnp.asarray(placed[full], jnp.float32)
        found = evaluate(
            jnp.asarray(latents[full], jnp.float32), rest, leaves, at, jnp.asarray(weights, jnp.float32),
            jnp.float32(deviation), space=space, residuals=residuals, num_regions=REGIONS**2,
        )  # fmt: skip
        return Evaluation(*(np.asarray(a)[: len(chosen)] for a in found))

    compiled = False

    def run(
        points: np.ndarray,
        needed: np.ndarray | None = None,
        *,
        horizon: float,
        weights: np.ndarray,
        deviation: float,
    ) -> Evaluation:
        nonlocal compiled
        part = functools.partial(some, latents=points, at=up_to(data, horizon), weights=weights, deviation=deviation)
        wanted = np.arange(len(points)) if needed is None else np.flatnonzero(needed)
        parts = [wanted[n : n + size] for n in range(0, len(wanted), size)]
        alone = 0 if compiled else 1  # the first call compiles; two threads would compile twice
        every = [part(chosen) for chosen in parts[:alone]]
        with ThreadPoolExecutor(threads) as pool:
            every += pool.map(part, parts[alone:])
        compiled = True
        total = [np.zeros((len(points), *a.shape[1:]), _wide(a.dtype)) for a in every[0]]
        for chosen, found in zip(parts, every, strict=True):
            for into, array in zip(total, found, strict=True):
                into[chosen] = array
        return Evaluation(*total)

    return run


def _wide(dtype: np.dtype) -> Any:
    """Double precision for floats."""
    return float if dtype.kind == "f" else dtype


def placements_of(env: Any, count: int, shake: float, spacing: float, seed: int) -> np.ndarray | None:
    """Rest positions for each start [m], shape (count, num_particles, 3); None if the environment has none.

    A simulation depends on where its particles happen to lie. Each start has its own placement, so the scatter of the
    fits shows how much. Vertices of a mesh are not displaced: that would strain it.
    """
    rest = getattr(env, "rest_positions", None)
    if rest is None or shake == 0.0 or isinstance(getattr(env, "scene", None), (TetScene, ThinScene, MixedScene)):
        return None
    generator = np.random.Generator(np.random.PCG64(seed + 1))
    return np.asarray(rest) + shake * spacing * generator.uniform(-1.0, 1.0, (count, *np.shape(rest)))


def spread_starts(space: Space, count: int, low: np.ndarray, high: np.ndarray, seed: int) -> np.ndarray:
    """The median, and a Latin hypercube over the middle of the priors, within the bounds, shape (count, k)."""
    generator = np.random.Generator(np.random.PCG64(seed))
    k = len(space.draws)
    reach_low, reach_high = np.maximum(low, -1.5), np.minimum(high, 1.5)
    strata = np.stack([generator.permutation(max(count - 1, 1)) for _ in range(k)], axis=1)
    shares = (strata + 0.5) / max(count - 1, 1)
    others = reach_low + shares * (reach_high - reach_low)
    return np.concatenate([np.clip(np.zeros((1, k)), low, high), others])[:count]


def _line(space: Space, search: lm.Starts, best: int, horizon: float, iteration: int) -> str:
    numbers = zip(space.labels, space.numbers(search.latents[best]), strict=True)
    values = "  ".join(f"{short(label)} {float(value):.4g}" for label, value in numbers)
    cost = float(search.total(space.precision)[best])
    return f"horizon {100 * horizon:3.0f} %  iteration {iteration + 1:2d}  cost {cost:10.4g}  {values}"


__all__ = ["REGIONS", "placements_of", "program", "search_from", "spread_starts"]
