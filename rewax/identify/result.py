"""Result of ``identify``, as values, as an environment, as distributions, as words and as a file."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax.envs.randomize import LeafDraws, LogNormal, Normal, Scale, Shift, with_numbers
from rewax.envs.randomize.stored import FORMAT, change_of, draws_of, read_result, told
from rewax.envs.registry import recipe
from rewax.identify.uncertainty import short
from rewax.identify.unknowns import Space
from rewax.whole_files import replacing

_Z95 = 1.959964


@dataclasses.dataclass(frozen=True, eq=False)
class Identified:
    """A fit.

    Attributes:
      space: the unknowns.
      latent: the mean of the starts that fit about equally well, of the finest environment, shape (k,).
      covariance: of the latent coordinates, shape (k, k).
      bounds: within which was searched, shape (k,) each.
      undetermined: sentences about directions that the data leave open.
      remarks: sentences about what was cut off or failed on the way.
      times: of the frames [s], shape (T,).
      residual_by_frame: residual of each frame, mean over the starts of ``latent`` [m], shape (T,).
      starts: the point that each start reached, shape (S, k).
      costs: cost at each of these points, shape (S,).
      history: the best value of each unknown by iteration, shape (iterations, k).
      failed: number of simulations that failed and were rejected.
      seconds: wall clock of the search, compilation included.
      env: the environment before the fit, with its reset noise; of several the last.
      made_by: how ``rewax.make`` built the environment that the result is for, by default ``env``.
    """

    space: Space
    latent: np.ndarray
    covariance: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]
    undetermined: list[str]
    remarks: list[str]
    times: np.ndarray
    residual_by_frame: np.ndarray
    starts: np.ndarray
    costs: np.ndarray
    history: np.ndarray
    failed: int
    seconds: float
    env: Any = None
    made_by: dict[str, Any] | None = None

    @property
    def values(self) -> dict[str, float]:
        """The numbers found, by the first name of each unknown."""
        return self._named(self.latent)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % of the posterior, cut off at the prior's bounds."""
        reach = _Z95 * np.sqrt(np.diag(self.covariance))
        low, high = self.space.bounds
        ends = [self.space.numbers(np.clip(self.latent + sign * reach, low, high)) for sign in (-1.0, 1.0)]
        return {label: (float(a), float(b)) for label, a, b in zip(self.space.labels, *ends, strict=True)}

    @property
    def at_bound(self) -> list[str]:
        """Unknowns whose value lies at a bound of the search."""
        close = (self.latent - self.bounds[0] < 1e-3) | (self.bounds[1] - self.latent < 1e-3)
        return [label for label, at in zip(self.space.labels, close, strict=True) if at]

    def fitted_env(self) -> Any:
        """The environment with the values found."""
        return self.space.place(self.env, jnp.asarray(self.latent, jnp.float32))

    def draws(self) -> LeafDraws:
        """The posterior of each unknown as a hook for ``randomize=``, cut off at the bounds of the search.

        A value that was extrapolated beyond these bounds is a bound itself.
        Correlations between unknowns are left out.
        """
        found = []
        ends = [self.space.numbers(np.clip(bound, *self.space.bounds)) for bound in self.bounds]
        for i, (names, draw) in enumerate(self.space.draws):
            if names[0].startswith("initial."):
                continue
            std = max(float(np.sqrt(self.covariance[i, i])), 1e-6) * self.space.scale_of(i)
            value = self.values[names[0]]
            within: dict[str, Any] = {"low": min(float(ends[0][i]), value), "high": max(float(ends[1][i]), value)}
            posterior = LogNormal(value, std, **within) if self.space.is_log[i] else Normal(value, std, **within)
            wrapped = type(draw)(posterior) if isinstance(draw, (Scale, Shift)) else posterior
            found.append((names, wrapped))
        return LeafDraws(tuple(found))

    def table(self) -> list[tuple[str, str, str, str]]:
        """Rows of name, value, 95 % interval and the share of the prior's standard deviation that is left."""
        rows = []
        for i, (label, value) in enumerate(self.values.items()):
            low, high = self.intervals[label]
            left = f"{100.0 * float(np.sqrt(self.covariance[i, i])):.0f} %"
            rows.append((short(label), f"{value:.4g}", f"{low:.4g} to {high:.4g}", left))
        return rows

    def save(self, path: str | Path) -> Path:
        """Write values, intervals, distributions, words and how the environment was made, as JSON."""
        path = Path(path)
        with replacing(path) as unfinished:
            unfinished.write_text(json.dumps(self._json(), indent=1) + "\n")
        return path

    def _named(self, latent: np.ndarray) -> dict[str, float]:
        return dict(zip(self.space.labels, map(float, self.space.numbers(latent)), strict=True))

    def _json(self) -> dict[str, Any]:
        kept = [
            {"names": list(names), "change": change_of(draw), "prior": told(draw), "posterior": told(after)}
            for (names, draw), (_, after) in zip(
                [d for d in self.space.draws if not d[0][0].startswith("initial.")], self.draws().draws, strict=True
            )
        ]
        return {
            "format": FORMAT, "made_by": self.made_by or recipe(self.env), "values": self.values,
            "intervals": {name: list(ends) for name, ends in self.intervals.items()}, "unknowns": kept,
            "covariance": self.covariance.tolist(), "covariance_of": list(self.space.labels),
            "undetermined": self.undetermined, "remarks": self.remarks,
            "times": self.times.tolist(), "residual_by_frame": self.residual_by_frame.tolist(), "failed": self.failed,
            "starts": [self._named(s) for s in self.starts],
            "costs": [float(c) if np.isfinite(c) else None for c in self.costs], "seconds": round(self.seconds, 2),
        }  # fmt: skip


@dataclasses.dataclass(frozen=True)
class SavedResult:
    """The part of a result's file that environments read.

    Attributes:
      made_by: arguments of ``rewax.make``: ``env``, ``scale``, ``kwargs``; None: the environment was built otherwise.
      draws: hook that draws from the posterior.
      values: by name.
    """

    made_by: dict[str, Any] | None
    draws: LeafDraws
    values: dict[str, float]

    def apply(self, env: Any) -> Any:
        """An environment with the values found."""
        numbers = [jnp.float32(self.values[names[0]]) for names, _ in self.draws.draws]
        return with_numbers(env, self.draws, numbers)


def load_result(path: str | Path) -> SavedResult:
    """Read what ``Identified.save`` wrote.

    Raises:
      ValueError: in one sentence: there is no such file, or it is no result.
    """
    found = read_result(path)
    return SavedResult(found["made_by"], draws_of(found["unknowns"]), found["values"])


__all__ = ["Identified", "SavedResult", "load_result"]
