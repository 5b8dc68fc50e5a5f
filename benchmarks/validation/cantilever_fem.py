"""Sag of a cantilever of tetrahedra under its own weight, against beam theory, over refinements.

A narrow beam is held at one end. Its shape at rest is found by Newton's method on ``tets.internal_force``, and is then
handed to ``tets.step``, which must leave it where it is. Linear tetrahedra are too stiff in bending: the sag approaches
theory from below, with the square of the cell's height. What is left with Poisson's ratio 0.3, some 1 %, is the clamped
end, whose section cannot contract as beam theory has it; with Poisson's ratio 0 the limit is Timoshenko's.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.validation.common import Check, in_float64, relative
from rewax.physics import mpm, tets
from rewax.physics.tets import stable_parameters, tetmesh

LENGTH, HEIGHT, WIDTH = 2.0, 0.25, 0.0625
"""[m], along x, y, z."""
YOUNGS_MODULUS, POISSONS_RATIO, DENSITY, GRAVITY = 4e8, 0.3, 1000.0, 9.81
CELLS = {"tiny": (2, 4), "small": (2, 4, 8), "full": (2, 4, 8, 16)}
"""Cells over the height, of each refinement; along the beam they are cubes."""


def theory(poissons_ratio: float = POISSONS_RATIO) -> dict[str, float]:
    """Tip sag [m] of a uniformly loaded cantilever: by bending alone, and with shear.

    Source: Euler-Bernoulli q L^4 / (8 E I); Timoshenko adds q L^2 / (2 k G A), Cowper's k = 10 (1 + nu) / (12 + 11 nu)
    for a rectangle.
    """
    area, inertia = WIDTH * HEIGHT, WIDTH * HEIGHT**3 / 12
    load = DENSITY * GRAVITY * area
    shear_modulus = YOUNGS_MODULUS / (2 * (1 + poissons_ratio))
    k = 10 * (1 + poissons_ratio) / (12 + 11 * poissons_ratio)
    bending = load * LENGTH**4 / (8 * YOUNGS_MODULUS * inertia)
    return {"euler_bernoulli": bending, "timoshenko": bending + load * LENGTH**2 / (2 * k * shear_modulus * area)}


def beam(cells_over_height: int, poissons_ratio: float = POISSONS_RATIO) -> tuple[tets.TetScene, tets.TetState]:
    """The undeformed beam, from x = 0, where it is held."""
    along = round(LENGTH / HEIGHT * cells_over_height)
    mesh = tetmesh.box(
        (LENGTH, HEIGHT, WIDTH),
        (along, cells_over_height, 1),
        center=(LENGTH / 2, 0.0, 0.0),
        tets_per_cell=5,
    )
    mu, lam = stable_parameters(YOUNGS_MODULUS, poissons_ratio)
    speed = np.sqrt(YOUNGS_MODULUS / DENSITY)
    scene = tets.make_scene(
        mesh=mesh,
        density=DENSITY,
        mu=mu,
        lam=lam,
        dt=0.1 * HEIGHT / cells_over_height / speed,
        gravity=(0.0, -GRAVITY, 0.0),
        held=np.flatnonzero(mesh.vertices[:, 0] < 1e-9),
    )
    return scene, tets.initial_state(mesh.vertices)


@jax.jit
def equilibrium(scene: tets.TetScene, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Positions at which internal forces balance gravity [m], and the largest force left [N].

    Newton's method with conjugate gradients on the force's derivative.
    """
    assert scene.mobility is not None
    free = scene.mobility[:, None]

    def force(x: jax.Array) -> jax.Array:
        state = tets.TetState(x=x, v=jnp.zeros_like(x))
        return free * (tets.internal_force(scene, state) + scene.mass[:, None] * scene.gravity)

    def newton(x: jax.Array, _: None) -> tuple[jax.Array, None]:
        def stiffness(dx: jax.Array) -> jax.Array:
            return -jax.jvp(force, (x,), (free * dx,))[1]

        dx, _ = jax.scipy.sparse.linalg.cg(stiffness, force(x), tol=1e-7, maxiter=20000)
        return x + dx, None

    x, _ = jax.lax.scan(newton, x, length=2)
    return x, jnp.max(jnp.abs(force(x)))


@jax.jit
def drift(scene: tets.TetScene, state: tets.TetState) -> jax.Array:
    """How far the furthest vertex goes in 200 substeps [m]."""
    after = tets.step(scene, state, mpm.static_poses(200, dtype=state.x.dtype))
    return jnp.max(jnp.abs(after.x - state.x))


def settle(cells: int, poissons_ratio: float) -> dict[str, float]:
    """One beam: its sag [m], the force left over its weight, and how far 200 substeps take it, over its sag."""
    scene, rest = beam(cells, poissons_ratio)
    x, residual = equilibrium(scene, rest.x)
    sag = -float(jnp.mean((x - rest.x)[rest.x[:, 0] > LENGTH - 1e-9, 1]))
    weight = float(jnp.sum(scene.mass)) * GRAVITY
    moved = float(drift(scene, rest.replace(x=x)))
    return {"num_tets": len(scene.tets), "sag": sag, "residual": float(residual) / weight, "drift": moved / sag}


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Sag over refinements.

    Args:
      scale: "tiny", "small" or "full".

    Returns:
      ``checks``. Arrays over refinements: ``cells`` over the height, ``num_tets``, ``sag`` [m], its relative ``error``
      against Euler-Bernoulli and ``error_timoshenko``, ``residual`` force over the beam's weight, ``drift`` of the
      simulation from the shape found, over its sag; ``error_without_clamp``: size of the error against Timoshenko with
      Poisson's ratio 0. Numbers: ``euler_bernoulli``, ``timoshenko`` [m].
    """
    if scale not in CELLS:
        raise ValueError(f"scale is {scale!r}: give one of {', '.join(CELLS)}")
    beams = [settle(cells, POISSONS_RATIO) for cells in CELLS[scale]]
    unclamped = [settle(cells, 0.0)["sag"] for cells in CELLS[scale]]
    columns = {name: np.asarray([one[name] for one in beams]) for name in beams[0]}
    expected = theory()
    without = np.abs(np.asarray(unclamped) / theory(0.0)["timoshenko"] - 1.0)
    height, sag, moved = CELLS[scale][-1], columns["sag"][-1], columns["drift"].max()
    bar = 0.13 if scale == "tiny" else 0.05
    falling = (without[1:] / without[:-1]).max()
    checks = [
        relative(f"tip sag against Euler-Bernoulli, {height} cells high", sag, expected["euler_bernoulli"], bar, "m"),
        relative("the same against Timoshenko", sag, expected["timoshenko"], bar, "m"),
        Check(
            what="largest ratio of errors from a mesh to the next, nu = 0",
            measured=falling, theory=0.25, error=falling, bar=0.3, error_unit="ratio",
        ),
        Check(what="drift in 200 substeps", measured=moved, theory=0.0, error=moved, bar=1e-6, error_unit="of sag"),
    ]  # fmt: skip
    return {
        "checks": checks,
        "cells": np.asarray(CELLS[scale]),
        **columns,
        **expected,
        "error": columns["sag"] / expected["euler_bernoulli"] - 1.0,
        "error_timoshenko": columns["sag"] / expected["timoshenko"] - 1.0,
        "error_without_clamp": without,
    }


def plot(results: dict[str, Any], path: str | Path) -> None:
    """Sag and its error over refinements, as a picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.0), layout="constrained", dpi=150)
    left, right = figure.subplots(1, 2)
    cells = results["cells"]
    left.plot(cells, 1e3 * results["sag"], "o-", color="#4c72b0", label="tetrahedra")
    for name, style in (("euler_bernoulli", "-"), ("timoshenko", "--")):
        left.axhline(1e3 * results[name], color="black", linestyle=style, label=name.replace("_", "-").title())
    left.set(xscale="log", xticks=cells, xticklabels=[str(int(c)) for c in cells], xlabel="cells over the height")
    left.set(ylabel="sag of the tip [mm]")
    left.minorticks_off()
    left.legend(frameon=False)
    error = 100 * results["error_without_clamp"]
    right.loglog(cells, 100 * np.abs(results["error"]), "s:", color="#dd8452", label="against Euler-Bernoulli")
    right.loglog(cells, 100 * np.abs(results["error_timoshenko"]), "o-", color="#4c72b0", label="against Timoshenko")
    right.loglog(cells, error, "^--", color="#2a7f4f", label="the same, Poisson's ratio 0")
    right.loglog(cells, error[0] * (cells[0] / cells) ** 2, color="black", linewidth=0.8, label="second order")
    right.set(xticks=cells, xticklabels=[str(int(c)) for c in cells], xlabel="cells over the height")
    right.set(ylabel="error of the sag [%]")
    right.minorticks_off()
    right.yaxis.set_major_formatter("{x:g}")
    right.legend(frameon=False)
    figure.savefig(path)
