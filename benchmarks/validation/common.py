"""Shared by the cases: what a check is, a recorded simulation, bodies in a plane or on a line, a fit, a figure."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.optimize

from rewax.physics import mpm
from rewax.physics.mpm import MPMScene, MPMState, Wall, WallKind
from rewax.physics.numerics import Pose
from rewax.physics.shapes import fill_box

SCALES = ("tiny", "small", "full")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """One number beside what it should be; relative error unless said otherwise."""

    what: str
    measured: float
    theory: float
    unit: str = ""
    error: float
    bar: float
    """Largest error that passes; infinite for a number that is only reported."""
    error_unit: str = ""
    """Empty: the error is relative."""

    @property
    def passed(self) -> bool:
        return bool(self.error <= self.bar)  # False for NaN


def relative(what: str, measured: float, theory: float, bar: float, unit: str = "") -> Check:
    """A check of the relative error |measured / theory - 1|."""
    measured, theory = float(measured), float(theory)
    return Check(what=what, measured=measured, theory=theory, unit=unit, error=abs(measured / theory - 1.0), bar=bar)


def in_float64(run: Callable[[str], dict[str, Any]]) -> Callable[[str], dict[str, Any]]:
    """Decorator of a case's ``run``: displacements that are small beside the body need float64."""

    @functools.wraps(run)
    def wrapped(scale: str = "small") -> dict[str, Any]:
        with jax.enable_x64(True):
            return run(scale)

    return wrapped


@functools.partial(jax.jit, static_argnames=("every", "num_samples", "observe"))
def record(
    scene: MPMScene,
    state: MPMState,
    *,
    every: int,
    num_samples: int,
    observe: Callable[[MPMScene, MPMState], Any],
    poses: Pose | None = None,
    keep: Any = 1.0,
    gravity: jax.Array | None = None,
) -> tuple[MPMState, Any]:
    """A simulation seen every ``every`` substeps.

    Args:
      scene, state: where it begins.
      every, num_samples: substeps between observations and how many observations (static).
      observe: what to keep of scene and state (static).
      poses: of the bodies at the every * num_samples + 1 boundaries of substeps; None for a scene without bodies.
      keep: factor on all velocities after every ``every`` substeps, shape () or (num_samples,); below one it damps.
      gravity: in place of the scene's, for each sample, shape (num_samples, 3).

    Returns:
      The last state, and the observations with a first axis over samples.
    """
    if poses is None:
        poses = mpm.static_poses(every * num_samples, dtype=state.x.dtype)

    keep = jnp.broadcast_to(jnp.asarray(keep, state.x.dtype), (num_samples,))

    def sample(state: MPMState, k: jax.Array) -> tuple[MPMState, Any]:
        now = scene if gravity is None else scene.replace(gravity=gravity[k])
        part = jax.tree.map(lambda p: jax.lax.dynamic_slice_in_dim(p, k * every, every + 1), poses)
        state = mpm.step(now, state, part, store_every=None)
        state = state.replace(v=keep[k] * state.v, C=keep[k] * state.C)
        return state, observe(scene, state)

    return jax.lax.scan(sample, state, jnp.arange(num_samples))


def fill(lower: tuple[float, ...], upper: tuple[float, ...], spacing: float) -> np.ndarray:
    """Particles of a box, two per cell and axis; an axis left out gets one layer at zero, as thick as their distance.

    Without motion along the missing axes, a layer moves as in two (one) dimensions: all layers of nodes get the same.
    """
    missing = 3 - len(lower)
    h = spacing / 2
    center = [(a + b) / 2 for a, b in zip(lower, upper, strict=True)] + missing * [0.0]
    size = [b - a for a, b in zip(lower, upper, strict=True)] + missing * [h]
    return fill_box(center, size, h)


def foremost(state: MPMState) -> jax.Array:
    """Largest x of the particles, but for the one in a thousand that may have come off [m]."""
    x = jnp.sort(state.x[:, 0])
    return x[-max(1, x.shape[0] // 1000)]


def held(spacing: float) -> Wall:
    """Give it to both sides of an axis with 4 nodes from -spacing on: nothing moves along it."""
    return Wall(position=0.5 * spacing, kind=WallKind.SLIP)


def fit_oscillation(t: np.ndarray, u: np.ndarray, omega: float) -> dict[str, float]:
    """Least squares of mean + exp(-decay t) (a cos(omega t) + b sin(omega t)), from a first guess of omega."""
    t, u = np.asarray(t, float), np.asarray(u, float)
    scale = np.max(np.abs(u))

    def parts(p: np.ndarray) -> np.ndarray:
        envelope = np.exp(-p[1] * omega * t)
        columns = [np.ones_like(t), envelope * np.cos(p[0] * omega * t), envelope * np.sin(p[0] * omega * t)]
        return np.stack(columns, axis=1)

    def residual(p: np.ndarray) -> np.ndarray:
        basis = parts(p)
        return (basis @ np.linalg.lstsq(basis, u, rcond=None)[0] - u) / scale

    p = scipy.optimize.least_squares(residual, np.array([1.0, 0.0])).x
    mean = np.linalg.lstsq(parts(p), u, rcond=None)[0][0]
    return {"mean": float(mean), "omega": float(p[0] * omega), "decay": float(p[1] * omega)}


def save(figure: plt.Figure, path: Path | str) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    plt.close(figure)
