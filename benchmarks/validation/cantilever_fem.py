"""Sag of a cantilever of tetrahedra under its own weight, against beam theory, over refinements.

    python benchmarks/validation/cantilever_fem.py                  # seconds: 3 refinements
    python benchmarks/validation/cantilever_fem.py --scale full     # a finer fourth

A narrow beam is held at one end. Its shape at rest is found by Newton's method on ``fem.internal_force``, and is then
handed to ``fem.step``, which must leave it where it is. Linear tetrahedra are too stiff in bending: the sag approaches
theory from below, with the square of the cell's height.
"""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import fem, mpm, tetmesh
from rewax.physics.tet_law import stable_parameters

LENGTH, HEIGHT, WIDTH = 2.0, 0.25, 0.0625
"""[m], along x, y, z."""
YOUNGS_MODULUS, POISSONS_RATIO, DENSITY, GRAVITY = 4e8, 0.3, 1000.0, 9.81
CELLS = {"tiny": (2, 4), "small": (2, 4, 8), "full": (2, 4, 8, 16)}
"""Cells over the height, of each refinement; along the beam they are cubes."""


def theory() -> dict[str, float]:
    """Tip sag [m] of a uniformly loaded cantilever: by bending alone, and with shear.

    Source: Euler-Bernoulli q L^4 / (8 E I); Timoshenko adds q L^2 / (2 k G A), Cowper's k = 10 (1 + nu) / (12 + 11 nu)
    for a rectangle.
    """
    area, inertia = WIDTH * HEIGHT, WIDTH * HEIGHT**3 / 12
    load = DENSITY * GRAVITY * area
    shear_modulus = YOUNGS_MODULUS / (2 * (1 + POISSONS_RATIO))
    k = 10 * (1 + POISSONS_RATIO) / (12 + 11 * POISSONS_RATIO)
    bending = load * LENGTH**4 / (8 * YOUNGS_MODULUS * inertia)
    return {"euler_bernoulli": bending, "timoshenko": bending + load * LENGTH**2 / (2 * k * shear_modulus * area)}


def beam(cells_over_height: int) -> tuple[fem.FEMScene, fem.FEMState]:
    """The undeformed beam, from x = 0, where it is held."""
    along = round(LENGTH / HEIGHT * cells_over_height)
    mesh = tetmesh.box(
        (LENGTH, HEIGHT, WIDTH),
        (along, cells_over_height, 1),
        center=(LENGTH / 2, 0.0, 0.0),
        tets_per_cell=5,
    )
    mu, lam = stable_parameters(YOUNGS_MODULUS, POISSONS_RATIO)
    speed = np.sqrt(YOUNGS_MODULUS / DENSITY)
    scene = fem.make_scene(
        mesh=mesh,
        density=DENSITY,
        mu=mu,
        lam=lam,
        dt=0.1 * HEIGHT / cells_over_height / speed,
        gravity=(0.0, -GRAVITY, 0.0),
        held=np.flatnonzero(mesh.vertices[:, 0] < 1e-9),
    )
    return scene, fem.initial_state(mesh.vertices)


@jax.jit
def equilibrium(scene: fem.FEMScene, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Positions at which internal forces balance gravity [m], and the largest force left [N].

    Newton's method with conjugate gradients on the force's derivative.
    """
    assert scene.mobility is not None
    free = scene.mobility[:, None]

    def force(x: jax.Array) -> jax.Array:
        state = fem.FEMState(x=x, v=jnp.zeros_like(x))
        return free * (fem.internal_force(scene, state) + scene.mass[:, None] * scene.gravity)

    def newton(x: jax.Array, _: None) -> tuple[jax.Array, None]:
        def stiffness(dx: jax.Array) -> jax.Array:
            return -jax.jvp(force, (x,), (free * dx,))[1]

        dx, _ = jax.scipy.sparse.linalg.cg(stiffness, force(x), tol=1e-7, maxiter=20000)
        return x + dx, None

    x, _ = jax.lax.scan(newton, x, length=2)
    return x, jnp.max(jnp.abs(force(x)))


@jax.jit
def drift(scene: fem.FEMScene, state: fem.FEMState) -> jax.Array:
    """How far the furthest vertex goes in 200 substeps [m]."""
    after = fem.step(scene, state, mpm.static_poses(200, dtype=state.x.dtype))
    return jnp.max(jnp.abs(after.x - state.x))


def run(scale: str = "small") -> dict[str, Any]:
    """Sag over refinements.

    Args:
      scale: "tiny", "small" or "full".

    Returns:
      Arrays over refinements: ``cells`` over the height, ``num_tets``, ``sag`` [m], relative ``error`` against
      Euler-Bernoulli and ``error_timoshenko``, ``residual`` force over the beam's weight. Numbers: ``euler_bernoulli``
      and ``timoshenko`` [m], and ``drift`` of the finest beam in 200 substeps, over its sag.
    """
    if scale not in CELLS:
        raise ValueError(f"scale is {scale!r}: give one of {', '.join(CELLS)}")
    expected = theory()
    columns: dict[str, list[float]] = {name: [] for name in ("cells", "num_tets", "sag", "residual")}
    moved = np.nan
    with jax.enable_x64(True):
        for cells in CELLS[scale]:
            scene, rest = beam(cells)
            x, residual = equilibrium(scene, rest.x)
            tip = rest.x[:, 0] > LENGTH - 1e-9
            sag = -float(jnp.mean((x - rest.x)[tip, 1]))
            columns["cells"].append(cells)
            columns["num_tets"].append(len(scene.tets))
            columns["sag"].append(sag)
            columns["residual"].append(float(residual) / (float(jnp.sum(scene.mass)) * GRAVITY))
        moved = float(drift(scene, rest.replace(x=x))) / sag
    results: dict[str, Any] = {name: np.asarray(column) for name, column in columns.items()}
    for name, key in (("euler_bernoulli", "error"), ("timoshenko", "error_timoshenko")):
        results[name] = expected[name]
        results[key] = results["sag"] / expected[name] - 1.0
    return results | {"drift": moved}


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
    left.legend(frameon=False)
    error = 100 * np.abs(results["error_timoshenko"])
    right.loglog(cells, error, "o-", color="#4c72b0", label="against Timoshenko")
    right.loglog(cells, 100 * np.abs(results["error"]), "s:", color="#dd8452", label="against Euler-Bernoulli")
    right.loglog(cells, error[0] * (cells[0] / cells) ** 2, color="black", linewidth=0.8, label="second order")
    right.set(xticks=cells, xticklabels=[str(int(c)) for c in cells], xlabel="cells over the height")
    right.set(ylabel="error of the sag [%]")
    right.minorticks_off()
    right.legend(frameon=False)
    figure.savefig(path)


if __name__ == "__main__":
    chosen = sys.argv[sys.argv.index("--scale") + 1] if "--scale" in sys.argv else "small"
    outcome = run(chosen)
    for key, value in outcome.items():
        print(f"{key:18} {value}")
    plot(outcome, "cantilever_fem.png")
