"""Cloth and ropes in motion: the periods of a hanging rope and a string, energy and momentum over 10,000 substeps."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, in_float64, relative, save
from benchmarks.validation.thin_common import NOTHING, amplitudes, period, settled
from rewax.physics import thin

SEGMENTS = {"tiny": 16, "small": 32, "full": 32}
SUBSTEPS = {"tiny": 1000, "small": 10_000, "full": 10_000}
FIRST_ZERO = 2.404825557695773
"""Of Bessel's function J_0."""
STRAIN = 0.05


def line(segments: int) -> thin.ThinMesh:
    return thin.rope(np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], segments + 1))


def pendulum(segments: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Times, amplitude of the first mode of a rope that hangs along x, period by theory."""
    mesh, rope = line(segments), thin.Rope(stretch=1e3, density=0.1)
    given = {"mesh": mesh, "rope": rope, "gravity": (9.81, 0.0, 0.0), "held": [0]}
    hung = settled(mesh.vertices, 200, **given)
    t = (np.arange(200) + 0.5) * np.pi / 200
    below = np.sqrt(np.clip(1.0 - mesh.vertices[:, 0], 0.0, 1.0))
    mode = np.mean(np.cos(FIRST_ZERO * below[:, None] * np.sin(t)), axis=1)
    scene = thin.make_scene(**given, dt=2e-4)
    state = thin.initial_state(hung + 0.01 * mode[:, None] * [0.0, 1.0, 0.0])
    return (*amplitudes(scene, state, mode, 50, 200), float(4 * np.pi / FIRST_ZERO * np.sqrt(1.0 / 9.81)))


def string(segments: int) -> tuple[np.ndarray, np.ndarray, float]:
    """The same for the first mode of a tight string."""
    mesh = line(segments)
    scene = thin.make_scene(
        mesh=mesh, rope=thin.Rope(stretch=1e3, density=0.1), gravity=NOTHING, held=[0, segments], dt=1e-4
    )
    mode = np.sin(np.pi * mesh.vertices[:, 0])
    state = thin.initial_state(mesh.vertices * (1 + STRAIN) + 1e-3 * mode[:, None] * [0.0, 1.0, 0.0])
    speed = np.sqrt(1e3 * STRAIN * (1.0 + STRAIN) / 0.1)
    return (*amplitudes(scene, state, mode, 5, 200), float(2 * (1.0 + STRAIN) / speed))


def free_sheet(substeps: int) -> dict[str, np.ndarray]:
    """A sheet that is shaken and thrown: energy and momentum at 100 times."""
    mesh = thin.sheet(0.4, 0.3, 4, 3)
    cloth = thin.isotropic_cloth(youngs_modulus=1e5, poissons_ratio=0.3, thickness=5e-3, density=300.0)
    scene = thin.make_scene(mesh=mesh, dt=1e-4, cloth=cloth, gravity=NOTHING)
    rng = np.random.default_rng(0)
    x, v = (s * rng.standard_normal(mesh.vertices.shape) for s in (5e-3, 0.2))
    state = thin.initial_state(mesh.vertices + x).replace(v=jnp.asarray(v + np.array([1.0, 0.5, -0.3])))
    poses = thin.static_poses(substeps // 100, dtype=float)

    @jax.jit
    def run(state: thin.ThinState) -> dict[str, jax.Array]:
        def sample(state: thin.ThinState, _: None) -> tuple[thin.ThinState, dict[str, jax.Array]]:
            energy = thin.kinetic_energy(scene, state) + thin.elastic_energy(scene, state)
            seen = {
                "energy": energy, "momentum": thin.momentum(scene, state),
                "angular": thin.angular_momentum(scene, state),
            }  # fmt: skip
            return thin.step(scene, state, poses, store_every=None), seen

        return jax.lax.scan(sample, state, None, 100)[1]

    return {name: np.asarray(a) for name, a in run(state).items()}


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Amplitudes over time, and conserved quantities."""
    results: dict[str, Any] = {"checks": []}
    for name, case in (("pendulum", pendulum), ("string", string)):
        times, values, theory = case(SEGMENTS[scale])
        results[name] = (times, values, theory)
        results["checks"].append(relative(f"{name}: period", period(times, values), theory, 0.005, "s"))
    count = SUBSTEPS[scale]
    seen = free_sheet(count)
    results["sheet"], results["substeps"] = seen, count
    drift = float(np.abs(seen["energy"] / seen["energy"][0] - 1).max())
    results["checks"].append(
        Check(what=f"energy of a free sheet over {count} substeps", measured=drift, theory=0.0, error=drift, bar=0.03)
    )
    for name in ("momentum", "angular"):
        change = np.linalg.norm(seen[name] - seen[name][0], axis=1).max() / np.linalg.norm(seen[name][0])
        label = "momentum" if name == "momentum" else "angular momentum"
        results["checks"].append(
            Check(
                what=f"{label} of the sheet over {count} substeps",
                measured=float(change),
                theory=0.0,
                error=float(change),
                bar=1e-10,
            )
        )
    return results


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, panels = plt.subplots(1, 3, figsize=(12, 3.2))
    for panel, name in zip(panels, ("pendulum", "string"), strict=False):
        times, values, theory = results[name]
        panel.plot(times, 1e3 * values[0] / np.cos(2 * np.pi * times[0] / theory) * np.cos(2 * np.pi * times / theory),
                   "k-", lw=1, label="theory")  # fmt: skip
        panel.plot(times[::4], 1e3 * values[::4], "o", ms=3, label=name)
        panel.set(xlabel="time [s]", ylabel="amplitude [mm]")
        panel.legend(frameon=False, fontsize=8, loc="upper center")
    energy = results["sheet"]["energy"]
    panels[2].plot(np.linspace(0, results["substeps"], len(energy)), 100 * (energy / energy[0] - 1), "-", lw=1)
    panels[2].set(xlabel="substep", ylabel="change of the energy [%]")
    save(figure, path)
