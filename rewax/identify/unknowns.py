"""Unknown parameters by name: priors, latent coordinates of unit scale, and the part of them that is stable."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.copied_geoms import check_colliders
from rewax.envs.randomize import (
    Distribution,
    Draw,
    LeafDraws,
    LogNormal,
    LogUniform,
    Normal,
    Per,
    Scale,
    Shift,
    Uniform,
    hook,
    with_numbers,
)
from rewax.physics import mpm, tets, thin
from rewax.physics.coupling.mixed import MixedScene, largest_stable_mixed_dt
from rewax.types import Array

_INITIAL = {f"initial.{what}[{i}]": (what, i) for what in ("position", "velocity") for i in range(3)}
"""Names of unknowns of the first state: a shift of the soft body [m] and its velocity [m/s]."""
_MARGIN = 1.0 + 1e-5
_FLAT = (LogUniform, Uniform)


@dataclasses.dataclass(frozen=True)
class Space:
    """The unknowns of a fit. Hashable, so that equal ones share compiled programs.

    A latent coordinate has mean 0 and standard deviation 1 under the prior. It is a linear function of the number, or
    of its logarithm where the prior is one of the logarithm.

    Attributes:
      draws: names and priors, in order; a prior is a distribution of the value, ``Scale`` or ``Shift`` of one.
    """

    draws: tuple[tuple[tuple[str, ...], Draw], ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """One for each unknown: its first name."""
        return tuple(names[0] for names, _ in self.draws)

    @property
    def priors(self) -> tuple[Distribution, ...]:
        given = [draw.by if isinstance(draw, (Scale, Shift)) else draw for _, draw in self.draws]
        return tuple(cast(Distribution, prior) for prior in given)  # others are refused

    @property
    def is_log(self) -> tuple[bool, ...]:
        return tuple(isinstance(prior, (LogUniform, LogNormal)) for prior in self.priors)

    @property
    def precision(self) -> np.ndarray:
        """Precision of the prior in latent coordinates: 1, or 0 for a flat prior, shape (k,)."""
        return np.array([0.0 if isinstance(prior, _FLAT) else 1.0 for prior in self.priors])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of latent coordinates, shape (k,) each; infinite where the prior has none."""
        center, scale = self._frame()
        with np.errstate(divide="ignore"):
            low, high = (
                [np.log(end) if log else end for end, log in zip(ends, self.is_log, strict=True)]
                for ends in ([p.low for p in self.priors], [p.high for p in self.priors])  # type: ignore[attr-defined]
            )
        return (np.array(low) - center) / scale, (np.array(high) - center) / scale

    def numbers(self, latent: Any) -> list[Any]:
        """The numbers of the unknowns; of an array of latent coordinates, shape (..., k). Gradient: exact."""
        center, scale = self._frame()
        xp = np if isinstance(latent, np.ndarray) else jnp
        linear = [center[i] + scale[i] * latent[..., i] for i in range(len(center))]
        return [xp.exp(value) if log else value for value, log in zip(linear, self.is_log, strict=True)]

    def latent(self, numbers: Sequence[float]) -> np.ndarray:
        """Latent coordinates of numbers, shape (k,)."""
        center, scale = self._frame()
        return (
            np.array([math.log(v) if log else v for v, log in zip(numbers, self.is_log, strict=True)]) - center
        ) / scale

    def place(self, env: Any, latent: Array) -> Any:
        """The environment with these parameters. Gradient: exact."""
        numbers = self.numbers(latent)
        chosen = [i for i, (names, _) in enumerate(self.draws) if names[0] not in _INITIAL]
        return with_numbers(env, LeafDraws(tuple(self.draws[i] for i in chosen)), [numbers[i] for i in chosen])

    def start(self, physics: Any, latent: Array) -> Any:
        """The first state with the unknown shift and velocity of its soft body. Gradient: exact."""
        for (names, _), number in zip(self.draws, self.numbers(latent), strict=True):
            if names[0] in _INITIAL:
                what, axis = _INITIAL[names[0]]
                soft = physics.soft
                moved = {
                    "position": {"x": soft.x.at[:, axis].add(number)},
                    "velocity": {"v": soft.v.at[:, axis].add(number)},
                }
                physics = physics.replace(soft=soft.replace(**moved[what]))
        return physics

    def scale_of(self, i: int) -> float:
        """Standard deviation of the prior of the number, or of its logarithm."""
        return float(self._frame()[1][i])

    def _frame(self) -> tuple[np.ndarray, np.ndarray]:
        center, scale = zip(*(_center_and_scale(prior) for prior in self.priors), strict=True)
        return np.array(center), np.array(scale)


def space_of(unknowns: Mapping[Any, Draw], env: Any) -> Space:
    """The checked unknowns of a fit.

    Args:
      unknowns: priors by the names of parameters, as ``rewax.envs.randomize.hook`` takes them; a tuple of names shares
        a number. ``initial.position[0..2]`` and ``initial.velocity[0..2]`` are of the soft body's first state.
      env: has these parameters.

    Raises:
      ValueError: a name fits no parameter, a prior is not ``LogUniform``, ``LogNormal``, ``Uniform`` or ``Normal``, two
        unknowns share a number, a geom does not reach the soft body (``copied_geoms``), or a first state is unknown of
        an environment without a soft body.
    """
    space = Space(hook(unknowns).draws)
    for (names, _), prior, label in zip(space.draws, space.priors, space.labels, strict=True):
        if not isinstance(prior, (LogUniform, LogNormal, Uniform, Normal)) or prior.per is not Per.LEAF:
            raise ValueError(
                f"the prior of {label} is {prior!r}: give LogUniform, LogNormal, Uniform or Normal of one number"
            )
        if label.startswith("initial.") and (len(names) > 1 or label not in _INITIAL):
            known = ", ".join(_INITIAL)
            raise ValueError(f"{label!r} is no unknown of the first state: use one of {known}, alone")
    check_colliders(env, space.place(env, jnp.full(len(space.draws), 0.1)))  # raises for unknown names, too
    if first := [label for label in space.labels if label in _INITIAL]:
        soft = getattr(jax.eval_shape(env.reset, jax.random.key(0)).physics, "soft", None)
        if not (hasattr(soft, "x") and hasattr(soft, "v")):
            kind = type(getattr(env, "unwrapped", env)).__name__
            raise ValueError(f"{first[0]} is of a soft body, and {kind} has none of one kind: leave it out")
    return space


def is_stable(env: Any) -> bool:
    """Whether the substep of an environment's scene is stable for its materials; True without a scene of rewax."""
    scene = getattr(getattr(env, "unwrapped", env), "scene", None)
    if not isinstance(scene, (mpm.MPMScene, tets.TetScene, thin.ThinScene, MixedScene)):
        return True
    margin = 1.0 / _MARGIN if isinstance(scene, mpm.MPMScene) else _MARGIN
    return scene.dt <= margin * float(_largest_stable_dt(scene))


@jax.jit
def _largest_stable_dt(scene: mpm.MPMScene | tets.TetScene | thin.ThinScene | MixedScene) -> Array:
    """The largest substep that the solvers' statuses allow [s], shape ()."""
    if isinstance(scene, MixedScene):
        limits = [_largest_stable_dt(scene.particles), _largest_stable_dt(scene.thin), largest_stable_mixed_dt(scene)]
    elif isinstance(scene, mpm.MPMScene):
        materials = scene.material if isinstance(scene.material, tuple) else (scene.material,)
        limits = [jnp.min(mpm.largest_stable_dt(material, scene.grid)) for material in materials]
    else:
        limits = [(tets if isinstance(scene, tets.TetScene) else thin).largest_stable_dt(scene)]  # pyright: ignore[reportArgumentType]
    return jnp.min(jnp.stack(limits))


def stable_bounds(space: Space, envs: Sequence[Any], beyond: float = 0.0) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Bounds of latent coordinates within which the environments are stable, and what they cut off, in words.

    Each coordinate is bounded with the others at their median; trials beyond that are rejected by their status.

    Args:
      space: the unknowns.
      envs: all have to be stable.
      beyond: how far the bounds may lie outside of the priors' ends; what is cut off there is not said.

    Raises:
      ValueError: the environment is not stable at the median of the priors.
    """
    low, high = (np.array(end) for end in space.bounds)
    low, high, ends = low - beyond, high + beyond, (low, high)
    said: list[str] = []
    center = np.clip(np.zeros(len(low)), *ends)
    if not _all_stable(space, envs, center):
        raise ValueError(
            "the substep is too long for the median of the priors: make the environment with a larger num_substeps, or "
            "give softer priors"
        )
    for i, label in enumerate(space.labels):
        for bound, end, way in ((low, ends[0], "down"), (high, ends[1], "up")):
            far = bound[i] if np.isfinite(bound[i]) else math.copysign(5.0, bound[i])
            inside = _furthest_stable(space, envs, center, i, far)
            if inside == far:
                continue
            bound[i] = inside
            if abs(inside - center[i]) < abs(end[i] - center[i]):
                value, wanted = (
                    float(space.numbers(np.where(np.arange(len(low)) == i, at, center))[i])
                    for at in (inside, end[i] if np.isfinite(end[i]) else far)
                )
                said.append(
                    f"{label} is searched {way} to {value:.4g} instead of {wanted:.4g}: beyond, the substep is too "
                    "long; make the environment with a larger num_substeps to search further"
                )
    return low, high, said


def _furthest_stable(space: Space, envs: Sequence[Any], center: np.ndarray, i: int, far: float) -> float:
    """The coordinate nearest to ``far`` that is stable, by bisection."""

    def stable(value: float) -> bool:
        latent = center.copy()
        latent[i] = value
        return _all_stable(space, envs, latent)

    if stable(far):
        return far
    inside, outside = center[i], far
    for _ in range(12):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if stable(middle) else (inside, middle)
    return float(inside)


def _all_stable(space: Space, envs: Sequence[Any], latent: np.ndarray) -> bool:
    return all(is_stable(space.place(env, jnp.asarray(latent))) for env in envs)


def _center_and_scale(prior: Any) -> tuple[float, float]:
    match prior:
        case LogUniform():
            return 0.5 * math.log(prior.low * prior.high), math.log(prior.high / prior.low) / math.sqrt(12.0)
        case LogNormal():
            return math.log(prior.median), prior.log_std
        case Uniform():
            return 0.5 * (prior.low + prior.high), (prior.high - prior.low) / math.sqrt(12.0)
        case _:
            return prior.mean, prior.std


__all__ = ["Space", "is_stable", "space_of", "stable_bounds"]
