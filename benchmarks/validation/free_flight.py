"""A thrown, spinning elastic block: the trajectory of symplectic Euler to rounding, angular momentum conserved.

Only the transfers and gravity act on the centre of mass, so after n substeps it must be at x_0 + n dt v_0 +
g dt^2 n (n + 1) / 2, and the angular momentum about it must stay what it was, whatever the block does in itself.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, fill, in_float64, record, save
from rewax.physics import mpm
from rewax.physics.mpm import Grid, Hencky, Material, invariants

SPACING = {"tiny": 0.1, "small": 0.05, "full": 0.025}
SIZE = (0.4, 0.2, 0.2)
GRAVITY, VELOCITY, SPIN, DURATION = (0.0, -9.81, 0.0), (2.0, 2.7, 0.0), 10.0, 0.55
START = (0.3, 0.3, 0.3)


def scene_and_state(spacing: float) -> tuple[mpm.MPMScene, mpm.MPMState]:
    x = fill(*_corners(), spacing)
    material = Material(density=1000.0, elasticity=Hencky(youngs_modulus=2e5, poissons_ratio=0.3))
    grid = Grid(shape=tuple(round(length / spacing) + 1 for length in (1.8, 1.0, 0.6)), spacing=spacing)
    scene = mpm.make_scene(
        grid=grid, dt=0.4 * spacing / 16.5, material=material, gravity=GRAVITY, particle_volume=np.prod(SIZE) / len(x)
    )
    spin = np.zeros((3, 3))
    spin[0, 1], spin[1, 0] = -SPIN, SPIN
    state = mpm.initial_state(jnp.asarray(x))
    v = np.asarray(VELOCITY) + (x - np.asarray(START)) @ spin.T
    return scene, state.replace(v=jnp.asarray(v), C=jnp.broadcast_to(spin, state.C.shape))


def _corners() -> tuple[tuple[float, ...], tuple[float, ...]]:
    half = np.asarray(SIZE) / 2
    return tuple(np.asarray(START) - half), tuple(np.asarray(START) + half)


def observe(scene: mpm.MPMScene, state: mpm.MPMState) -> dict[str, Any]:
    middle = jnp.mean(state.x, axis=0)
    # Three particles tell where the block is and how it is turned.
    corners = state.x[jnp.asarray([0, state.x.shape[0] - 1])]
    return {"middle": middle, "spin": invariants.angular_momentum(scene, state, middle), "corners": corners}


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Relative deviations from the exact trajectory and from the initial angular momentum."""
    scene, state = scene_and_state(SPACING[scale])
    every = 5
    num_samples = round(DURATION / (scene.dt * every))
    start = observe(scene, state)
    _, seen = record(scene, state, every=every, num_samples=num_samples, observe=observe)
    n = every * np.arange(1, num_samples + 1)[:, None]
    g, v, dt = np.asarray(GRAVITY), np.asarray(VELOCITY), scene.dt
    exact = np.asarray(START) + n * dt * v + g * dt**2 * n * (n + 1) / 2
    middle, spin = np.asarray(seen["middle"]), np.asarray(seen["spin"])
    path = np.linalg.norm(exact - np.asarray(START), axis=1).max()
    off_path = np.linalg.norm(middle - exact, axis=1) / path
    L = np.asarray(start["spin"])
    off_spin = np.linalg.norm(spin - L, axis=1) / np.linalg.norm(L)
    far = int(np.argmax(off_path))
    checks = [
        Check(what="distance from the start, where it is worst", measured=float(np.linalg.norm(middle[far] - START)),
              theory=float(np.linalg.norm(exact[far] - START)), unit="m", error=float(off_path.max()), bar=1e-10),
        Check(what="angular momentum about the centre, at the end", measured=float(spin[-1, 2]), theory=float(L[2]),
              unit="kgm2/s", error=float(off_spin.max()), bar=1e-10),
    ]  # fmt: skip
    return {
        "checks": checks, "t": n[:, 0] * dt, "middle": middle, "exact": exact, "off_path": off_path,
        "off_spin": off_spin, "corners": np.asarray(seen["corners"]),
    }  # fmt: skip


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
    left.plot(*results["exact"][:, :2].T, "k-", lw=1, label="theory")
    every = max(1, len(results["t"]) // 12)
    left.plot(*results["middle"][::every, :2].T, "o", ms=4, label="centre of mass")
    for k, corners in enumerate(results["corners"][::every]):
        left.plot(*corners[:, :2].T, "C0-", lw=1, alpha=0.5, label=None if k else "a diagonal of the block")
    left.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", ylim=(0.0, 0.95))
    left.legend(frameon=False, fontsize=8, loc="lower center")
    for name, label in (("off_path", "trajectory"), ("off_spin", "angular momentum")):
        right.semilogy(results["t"], np.maximum(results[name], 1e-17), label=label)
    right.axhline(1e-10, color="k", ls=":", label="bar")
    right.set(xlabel="time [s]", ylabel="relative error [-]")
    right.legend(frameon=False, fontsize=8)
    save(figure, path)
