"""How certain a fit is: Laplace's approximation with errors that neighbours share, and what data leave open."""

import numpy as np
from scipy.special import stdtrit

from rewax.identify.unknowns import Space

UNDETERMINED = 0.5
"""A direction whose posterior standard deviation exceeds this share of the prior's is called undetermined."""
_MATTERS = 0.25
"""Exponents below this share of the largest one are left out of the words."""


def posterior(hessian: np.ndarray, scores: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Covariance of the latent coordinates, shape (k, k).

    Residuals of neighbouring points are no independent observations: the error of a coarse surface is the same at all
    points of a region, and from frame to frame. So the scatter of the gradient is estimated from the regions' sums
    (the sandwich of robust statistics). To this comes what fits with other placements and resolutions differ by.

    Args:
      hessian: H of Gauss and Newton without the prior, residuals divided by their deviation, shape (k, k).
      scores: gradients by region, shape (num_regions, k).
      between: covariance of these differences, see ``combined``, shape (k, k).

    Returns:
      (I + (H^-1 B H^-1 + between)^-1)^-1 with B the sum of H and of the scatter of the gradients by region; the prior
      has covariance I. H keeps the result from being too certain where few regions tell the scatter. Where errors are
      independent, both are equal, and the standard deviation is up to sqrt(2) too large.

    Source: Liang & Zeger 1986, "Longitudinal data analysis using generalized linear models", eq. 3, and a prior.
    """
    count, k = len(scores), len(hessian)
    centered = scores - scores.mean(0)
    scatter = hessian + count / max(count - 1, 1) * centered.T @ centered
    scatter = scatter + 1e-9 * max(float(np.trace(scatter)), 1e-12) * np.eye(k)
    information = hessian @ np.linalg.solve(scatter, hessian)
    within = np.linalg.inv(np.eye(k) + 0.5 * (information + information.T))
    # (within^-1 - I) is the information of one fit; adding `between` to its inverse needs no inverse of a singular one.
    root = np.linalg.cholesky(between + 1e-12 * np.eye(k))
    information = np.linalg.inv(within) - np.eye(k)
    middle = np.linalg.inv(np.eye(k) + root.T @ information @ root)
    total = information - information @ root @ middle @ root.T @ information
    return np.linalg.inv(np.eye(k) + 0.5 * (total + total.T))


def combined(
    latents: np.ndarray,
    groups: np.ndarray,
    spacings: np.ndarray | None = None,
    limit: float = 0.0,
    beyond: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The result of fits with different placements and resolutions, and the covariance of what they differ by.

    Without spacings, the result is the mean of the last group, the finest resolution. Its covariance is that of the
    placements, for a body whose own placement is one more draw, and the mean square of the other groups' differences
    from it. The former is enlarged by the squared ratio of the quantiles of Student's and of the normal distribution at
    97.5 %, so that 1.96 standard deviations are an interval of 95 % although few fits tell the covariance. One fit for
    each group tells nothing about it: it is then zero.

    With spacings of the grids, the result is that of the line through the first and the last mean, at ``limit``: the
    error of a simulation is taken as proportional to the spacing. The covariance of the placements is enlarged as the
    line enlarges it, and half of the step from the finest mean to the limit counts as an error of this assumption. A
    coarsest fit beyond the prior, or at the end of the stable range, is too far for the line: errors that large fall
    faster than the spacing. The result is then the middle of this step, whose ends are one standard deviation away.

    Args:
      latents: of the fits, shape (S, k).
      groups: number of the environment of each, rising with its resolution, shape (S,).
      spacings: of the grid of each environment, falling [m]; None: no extrapolation.
      limit: spacing at which the result is wanted [m], below the finest; 0: matter.
      beyond: coordinates whose coarsest fit is too far, shape (k,), bool; None: there are none.

    Returns:
      The mean, shape (k,), and the covariance, shape (k, k).
    """
    names = np.unique(groups)
    means = np.stack([latents[groups == g].mean(0) for g in names])
    apart = latents - means[np.searchsorted(names, groups)]
    covariance = np.zeros((latents.shape[1],) * 2)
    free, z = len(latents) - len(names), 1.959964
    step, counts = 0.0, [int((groups == g).sum()) for g in (names[0], names[-1])]
    if spacings is not None and len(names) > 1:
        first, last = spacings[names[0]], spacings[names[-1]]
        step = (last - limit) / (first - last)
    if free > 0:
        student = float(stdtrit(free, 0.975))
        share = 1.0 + (1.0 + step) ** 2 / counts[1] + step**2 / counts[0]
        covariance = (student / z) ** 2 * share * apart.T @ apart / free
    moved = step * (means[-1] - means[0])
    if spacings is not None:
        covariance = covariance + 0.25 * np.outer(moved, moved)
    elif len(names) > 1:
        coarser = means[:-1] - means[-1]
        covariance = covariance + coarser.T @ coarser / len(coarser)
    return means[-1] + (moved if beyond is None else np.where(beyond, 0.5, 1.0) * moved), covariance


def undetermined(space: Space, covariance: np.ndarray) -> list[str]:
    """Directions that the data do not determine, a sentence for each; and pairs of which they fix a combination."""
    values, vectors = np.linalg.eigh(covariance)
    said = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value**0.5 <= UNDETERMINED:
            continue
        large = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) > _MATTERS * np.abs(vector).max()]
        share = f"{100.0 * value**0.5:.0f} % of the prior's standard deviation is left"
        if len(large) == 1:
            said.append(f"The data do not determine {short(space.labels[large[0]])}: {share}.")
        else:
            said.append(f"The data do not determine {_combination(space, vector, large)}: {share}.")
    return said


def _combination(space: Space, vector: np.ndarray, chosen: list[int]) -> str:
    """``a^1 * b^-0.5``, of numbers whose logarithms are coordinates; else ``1 a - 0.5 b`` in units of the priors."""
    scaled = np.array([vector[i] / space.scale_of(i) for i in chosen])
    scaled = scaled / scaled[np.argmax(np.abs(scaled))]
    labels = [short(space.labels[i]) for i in chosen]
    if all(space.is_log[i] for i in chosen):
        return " * ".join(f"{label}^{power:.2g}" for label, power in zip(labels, scaled, strict=True))
    return "the combination " + " ".join(f"{factor:+.2g} {label}" for label, factor in zip(labels, scaled, strict=True))


def short(label: str) -> str:
    """The last part of a name, for words and tables."""
    return label if label.startswith("initial.") else label.split(".")[-1]


__all__ = ["UNDETERMINED", "combined", "posterior", "short", "undetermined"]
