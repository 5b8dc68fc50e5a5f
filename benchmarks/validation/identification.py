"""What a body is made of, recovered from one observed trajectory by the derivative of the simulation.

A block collapses on a rough floor, in plane strain: elastic, dough, viscous fluid, sand. A tenth of its particles are
seen at ten times, each coordinate with an error of 1 % of a cell. From a first guess that is a third off, Gauss-Newton
steps with the forward derivative of the whole trajectory find the one unknown parameter.
"""

import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import fill, held, record, relative, save
from rewax.physics import mpm
from rewax.physics.mpm import DruckerPrager, Grid, Hencky, Material, Newtonian, Tait, VonMises, Wall, WallKind, Walls
from rewax.struct import replace_leaf

CELLS = {"tiny": 6, "small": 8, "full": 16}
"""Over the width of the block; it is twice as high."""
SIDE, DENSITY, GRAVITY = 0.1, 1000.0, 9.81
DURATION, NUM_SAMPLES, COURANT = 0.2, 10, 0.3
OBSERVED_EVERY, NOISE = 10, 0.01
MAX_STEPS, DONE = 12, 1e-5


class Unknown(NamedTuple):
    """A parameter to be found."""

    path: str
    """In the scene's material."""
    unit: str
    guess: float
    material: Material
    """Holds the true value."""


def _solid(youngs_modulus: float, **laws: Any) -> Material:
    elasticity = Hencky(youngs_modulus=youngs_modulus, poissons_ratio=0.3)
    return Material(density=DENSITY, elasticity=elasticity, **laws)


UNKNOWNS = {
    "elastic block": Unknown("elasticity.youngs_modulus", "Pa", 2e4, _solid(3e4)),
    "dough": Unknown("plasticity.yield_stress", "Pa", 400.0, _solid(5e4, plasticity=VonMises(yield_stress=600.0))),
    "fluid": Unknown(
        "viscosity.viscosity",
        "Pa s",
        4.0,
        Material(
            density=DENSITY,
            elasticity=Tait(speed_of_sound=8.0),
            viscosity=Newtonian(viscosity=6.0),
        ),
    ),
    "sand": Unknown(
        "plasticity.friction_angle",
        "rad",
        float(np.deg2rad(20.0)),
        _solid(1e5, plasticity=DruckerPrager(friction_angle=np.deg2rad(30.0))),
    ),
}


def block(cells: int, material: Material) -> tuple[mpm.MPMScene, mpm.MPMState]:
    """It stands in the middle of a floor that it cannot slip on."""
    spacing = SIDE / cells
    x = fill((-0.5 * SIDE, 0.0), (0.5 * SIDE, 2.0 * SIDE), spacing)
    material = jax.tree.map(lambda a: jnp.asarray(a, jnp.result_type(float)), material)
    unit = Grid(shape=(4, 4, 4), spacing=spacing)
    dt = COURANT / mpm.STABLE_COURANT_NUMBER * float(mpm.largest_stable_dt(material, unit))
    scene = mpm.make_scene(
        grid=Grid(shape=(6 * cells, 3 * cells + 4, 4), spacing=spacing, origin=(-3 * SIDE, -2 * spacing, -spacing)),
        dt=DURATION / NUM_SAMPLES / np.ceil(DURATION / NUM_SAMPLES / dt),
        material=material,
        particle_volume=(spacing / 2) ** 3,
        gravity=(0.0, -GRAVITY, 0.0),
        walls=Walls(
            lower=(None, Wall(position=0.01 * spacing, kind=WallKind.GRIPPING), held(spacing)),
            upper=(None, None, held(spacing)),
        ),
    )
    return scene, mpm.initial_state(jnp.asarray(x), scene)


def _seen(scene: mpm.MPMScene, state: mpm.MPMState) -> jax.Array:
    return state.x[::OBSERVED_EVERY, :2]


@functools.partial(jax.jit, static_argnames=("path", "every"))
def predict(scene: mpm.MPMScene, state: mpm.MPMState, value: jax.Array, *, path: str, every: int) -> Any:
    """What would be seen, (NUM_SAMPLES, num_seen, 2), if the parameter were ``value``; its derivative by log value."""

    def seen(log_value: jax.Array) -> jax.Array:
        changed = replace_leaf(scene, f"material.{path}", jnp.exp(log_value))
        return record(changed, state, every=every, num_samples=NUM_SAMPLES, observe=_seen)[1]

    log_value = jnp.log(value)
    return jax.jvp(seen, (log_value,), (jnp.ones_like(log_value),))


def identify(scene: mpm.MPMScene, state: mpm.MPMState, unknown: Unknown, seed: int = 0) -> dict[str, Any]:
    """Guesses one after the other, and the root mean square difference between seen and predicted [m] of each."""
    every = round(DURATION / NUM_SAMPLES / scene.dt)
    simulate = functools.partial(predict, scene, state, path=unknown.path, every=every)
    true = functools.reduce(getattr, unknown.path.split("."), scene.material)
    exact = np.asarray(simulate(true)[0])
    seen = exact + NOISE * scene.grid.spacing * np.random.default_rng(seed).standard_normal(exact.shape)

    def difference(value: float) -> tuple[float, float]:
        """Root mean square of the difference, and the Gauss-Newton step of log value that would end it."""
        x, slope = (np.asarray(a, np.float64) for a in simulate(jnp.asarray(value, true.dtype)))
        return float(np.sqrt(np.mean((x - seen) ** 2))), float(np.sum((seen - x) * slope) / np.sum(slope**2))

    values = [unknown.guess]
    error, step = difference(values[0])
    errors = [error]
    for _ in range(MAX_STEPS):
        step = float(np.clip(step, -0.3, 0.3))
        candidate = values[-1] * np.exp(step)
        error, next_step = difference(candidate)
        if error >= errors[-1]:
            step *= 0.3  # too far: the trajectory is not linear in the parameter
            if abs(step) < DONE:
                break
            continue
        values.append(candidate)
        errors.append(error)
        step = next_step
    return {"values": np.array(values), "errors": np.array(errors), "true": float(true)}


def run(scale: str = "small") -> dict[str, Any]:
    """The way from the guess to the true value for every unknown (for dough and sand at the scale of the tests)."""
    checks, paths = [], {}
    for name in list(UNKNOWNS)[1::2] if scale == "tiny" else UNKNOWNS:
        unknown = UNKNOWNS[name]
        scene, state = block(CELLS[scale], unknown.material)
        paths[name] = identify(scene, state, unknown)
        what = f"{unknown.path.split('.')[-1]} of {name}, guessed {unknown.guess:.3g}"
        checks.append(relative(what, paths[name]["values"][-1], paths[name]["true"], 0.02, unknown.unit))
    return {"checks": checks, "paths": paths}


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    for name, found in results["paths"].items():
        unknown = UNKNOWNS[name]
        left.plot(found["values"] / found["true"], "o-", ms=3, lw=1, label=f"{unknown.path.split('.')[-1]} of {name}")
        right.semilogy(found["errors"] * 1e3, "o-", ms=3, lw=1)
    left.axhline(1.0, color="k", ls=":", lw=1)
    left.set(xlabel="Gauss-Newton step", ylabel="estimate / true value")
    right.set(xlabel="Gauss-Newton step", ylabel="r.m.s. difference from seen [mm]")
    left.legend(frameon=False, fontsize=8)
    save(figure, path)
