"""Levenberg-Marquardt with bounds for several starts side by side. Failed simulations are rejected steps.

The loop is Python's, so that it can report and pull back steps that are known to be unstable before they cost a
simulation. What it calls is one compiled program.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rewax.identify.evaluation import Evaluation

_FIRST_DAMPING, _LESS, _MORE, _MOST = 1e-2, 0.2, 5.0, 1e6
_STEP_TOLERANCE = 2e-3
"""A start has converged when a step moves it by less than this, in standard deviations of the prior."""
_GAIN_TOLERANCE = 1e-4
"""Nor is a step tried from which the model expects a smaller share of the cost."""
_LARGEST_STEP = 1.0
"""In standard deviations of the prior, along each coordinate."""


@dataclasses.dataclass
class Starts:
    """The state of the search.

    Attributes:
      latents: accepted points, shape (S, k).
      evaluation: there, arrays of NumPy.
      damping: shape (S,).
      active: not yet converged, shape (S,), bool.
      rejected: simulations that failed, by start, shape (S,).
    """

    latents: np.ndarray
    evaluation: Evaluation
    damping: np.ndarray
    active: np.ndarray
    rejected: np.ndarray

    def total(self, precision: np.ndarray) -> np.ndarray:
        """Cost with that of the prior, infinite where the simulation failed, shape (S,)."""
        return total_cost(self.evaluation, self.latents, precision)

    def best(self, precision: np.ndarray) -> int:
        return int(np.argmin(self.total(precision)))


def total_cost(evaluation: Evaluation, latents: np.ndarray, precision: np.ndarray) -> np.ndarray:
    return np.where(evaluation.ok, evaluation.cost + 0.5 * (precision * latents**2).sum(-1), np.inf)


def joined(searches: Sequence[Starts]) -> Starts:
    """The starts of several searches, one after the other."""
    fields = {f.name: [getattr(one, f.name) for one in searches] for f in dataclasses.fields(Starts)}
    evaluation = Evaluation(*(np.concatenate(arrays) for arrays in zip(*fields.pop("evaluation"), strict=True)))
    return Starts(evaluation=evaluation, **{name: np.concatenate(arrays) for name, arrays in fields.items()})


def begin(latents: np.ndarray, evaluation: Evaluation, rejected: np.ndarray | None = None) -> Starts:
    """Starts at points that were evaluated."""
    count = len(latents)
    failed = np.zeros(count, int) if rejected is None else rejected
    return Starts(latents.copy(), evaluation, np.full(count, _FIRST_DAMPING), np.ones(count, bool), failed)


def iterate(
    starts: Starts,
    evaluate: Callable[[np.ndarray, np.ndarray], Evaluation],
    *,
    precision: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    is_stable: Callable[[np.ndarray], bool],
) -> Starts:
    """One step of each active start: solved, cut off at the bounds, tried, accepted if the cost falls.

    ``evaluate`` takes points of all starts, shape (S, k), and which of them are needed, shape (S,).
    """
    proposals = starts.latents.copy()
    hopeful = starts.active.copy()
    for s in np.flatnonzero(starts.active).tolist():
        step = _step(starts, s, precision, bounds)
        hopeful[s] = _expected_gain(starts, s, step, precision) > _GAIN_TOLERANCE
        if not hopeful[s]:
            continue
        for _ in range(8):  # known to be unstable: half the step
            proposals[s] = np.clip(starts.latents[s] + step, *bounds)
            if is_stable(proposals[s]):
                break
            step = 0.5 * step
        else:
            proposals[s] = starts.latents[s]
    starts = dataclasses.replace(starts, active=hopeful)
    if not hopeful.any():
        return starts
    new = evaluate(proposals, hopeful)
    old_cost, new_cost = starts.total(precision), total_cost(new, proposals, precision)
    # A start without a valid simulation goes on towards the median, whatever it finds on the way.
    accepted = starts.active & ((new_cost < old_cost) | np.isinf(old_cost))
    moved = np.abs(proposals - starts.latents).max(1)
    rejected = starts.rejected + (starts.active & ~np.asarray(new.ok))
    damping = np.where(accepted, starts.damping * _LESS, starts.damping * _MORE)
    small = np.where(accepted, moved, 0.0 * moved) < _STEP_TOLERANCE
    gave_up = (damping > _MOST) | (~accepted & (moved < 0.1 * _STEP_TOLERANCE))
    active = starts.active & ~(accepted & small) & ~gave_up
    return Starts(
        latents=np.where(accepted[:, None], proposals, starts.latents),
        evaluation=_chosen(accepted, new, starts.evaluation),
        damping=np.where(starts.active, damping, starts.damping),
        active=active,
        rejected=rejected,
    )


def _step(starts: Starts, s: int, precision: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The damped step of one start; coordinates that a bound stops keep still."""
    latent, e = starts.latents[s], starts.evaluation
    if not e.ok[s]:
        return -0.5 * latent  # towards the median of the prior, where the simulation is most likely to work
    gradient = e.gradient[s] + precision * latent
    hessian = e.hessian[s] + np.diag(precision)
    stopped = ((latent <= bounds[0]) & (gradient > 0)) | ((latent >= bounds[1]) & (gradient < 0))
    free = ~stopped
    step = np.zeros_like(latent)
    if free.any():
        h = hessian[np.ix_(free, free)]
        damped = h + starts.damping[s] * np.diag(np.diag(h)) + 1e-9 * max(np.trace(h), 1e-12) * np.eye(len(h))
        step[free] = np.linalg.solve(damped, -gradient[free])
    largest = np.abs(step).max()
    return step * min(1.0, _LARGEST_STEP / largest) if largest > 0 else step


def _expected_gain(starts: Starts, s: int, step: np.ndarray, precision: np.ndarray) -> float:
    """Share of the cost that a step saves by the quadratic model; infinite after a failed simulation."""
    e = starts.evaluation
    if not e.ok[s]:
        return np.inf
    gradient = e.gradient[s] + precision * starts.latents[s]
    hessian = e.hessian[s] + np.diag(precision)
    gain = -(gradient @ step + 0.5 * step @ hessian @ step)
    return float(gain / max(starts.total(precision)[s], 1e-30))


def _chosen(accepted: np.ndarray, new: Any, old: Any) -> Evaluation:
    def pick(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.where(accepted.reshape(-1, *[1] * (np.ndim(a) - 1)), a, b)

    return Evaluation(*(pick(np.asarray(a), np.asarray(b)) for a, b in zip(new, old, strict=True)))


__all__ = ["Starts", "begin", "iterate", "joined", "total_cost"]
