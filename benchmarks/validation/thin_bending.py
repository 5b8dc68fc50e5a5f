"""Bending of rods and plates under refinement, and Euler's load: linear theory against exact solutions."""

import itertools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, in_float64, relative, save
from benchmarks.validation.thin_common import NOTHING, deflections, stiffness
from rewax.physics import thin

CELLS = {"tiny": (4, 8), "small": (4, 8, 16), "full": (4, 8, 16, 32)}
SQUARES = {"tiny": (4, 8), "small": (4, 8, 16), "full": (4, 8, 16, 24)}
RIGIDITY, DENSITY, RATIO = 1e-2, 0.3, 0.3
LOADS = np.linspace(0.2, 1.8, 9)
EULER = np.pi**2 * RIGIDITY
SUPPORTED = 0.00406235
"""Deflection of the middle of a supported unit square over load over rigidity: Timoshenko and Woinowsky-Krieger 1959,
table 8."""


def rod(cells: int, **changes: Any) -> tuple[thin.ThinScene, np.ndarray]:
    mesh = thin.rope(np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], cells + 1))
    material = thin.Rope(stretch=1e4, bending=RIGIDITY, density=DENSITY)
    return thin.make_scene(mesh=mesh, dt=1e-7, rope=material, gravity=NOTHING, **changes), mesh.vertices


def plate(width: float, across: int, along: int, ratio: float) -> tuple[thin.ThinScene, np.ndarray]:
    mesh = thin.sheet(1.0, width, along, across)
    cloth = thin.Cloth(warp=1e3, weft=1e3, shear=500.0, bending=RIGIDITY, bending_ratio=ratio, density=DENSITY)
    return thin.make_scene(mesh=mesh, dt=1e-7, cloth=cloth, gravity=NOTHING), mesh.vertices


def tip(scene: thin.ThinScene, x: np.ndarray, cells: int) -> float:
    """Deflection of the free end over w L^4 / (8 D); the clamp ends in the middle of the held cell."""
    moved = deflections(scene, x, x[:, 0] < 1.5 / cells)
    return float(moved[x[:, 0] > 1 - 1e-9].mean() / (DENSITY * (1 - 0.5 / cells) ** 4 / (8 * RIGIDITY)))


def middle(cells: int) -> float:
    """Deflection of the middle of a supported square over theory's."""
    scene, x = plate(1.0, cells, cells, RATIO)
    rim = np.any((x[:, [0, 2]] < 1e-9) | (x[:, [0, 2]] > 1 - 1e-9), axis=1)
    return float(deflections(scene, x, rim)[len(x) // 2] / (SUPPORTED * DENSITY / RIGIDITY))


def softest(cells: int) -> np.ndarray:
    """Stiffness of the softest transverse mode of a pinned rod over that without load, for loads over Euler's."""
    scene, x = rod(cells)
    inner = np.arange(1, cells)
    found = []
    for load in (0.0, *LOADS * EULER):
        squeezed = jnp.asarray(x * (1 - load / 1e4))
        found.append(np.linalg.eigvalsh(np.asarray(stiffness(scene, squeezed))[np.ix_(inner, inner)])[0])
    return np.asarray(found[1:]) / found[0]


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Errors over cells, the order of convergence, and stiffness over load."""
    cells, squares = CELLS[scale], SQUARES[scale]
    curves = {
        "rod": (cells, [tip(*rod(n), n) - 1 for n in cells]),
        "strip": (cells, [tip(*plate(1.0 / n, 1, n, 0.0), n) - 1 for n in cells]),
        "supported square": (squares, [middle(n) - 1 for n in squares]),
    }
    checks, bar = [], 0.05 if scale == "tiny" else 0.03
    for name, (counts, errors) in curves.items():
        checks.append(relative(f"{name}, {counts[-1]} cells: deflection over theory's", 1 + errors[-1], 1.0, bar))
        (a, b), (c, d) = list(itertools.pairwise(counts))[-1], [abs(e) for e in errors[-2:]]
        order = float(np.log(c / d) / np.log(b / a))
        checks.append(
            Check(what=f"{name}: order of convergence", measured=order, theory=2.0, error=2.0 - order, bar=0.4)
        )
    soft = softest(cells[-1])
    load = float(np.interp(0.0, -soft, LOADS))
    checks.append(relative(f"rod of {cells[-1]} segments: load at which it buckles over Euler's", load, 1.0, 0.02))
    return {"checks": checks, "curves": curves, "soft": soft}


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    for (name, (counts, errors)), style in zip(results["curves"].items(), ("o-", "s-", "^-"), strict=True):
        left.loglog(counts, np.abs(errors), style, label=name)
    n = np.asarray(results["curves"]["rod"][0], float)
    left.loglog(n, 0.8 / n**2, "k:", lw=1, label="second order")
    left.set(xlabel="cells", ylabel="relative error of the deflection")
    left.set_xticks(n, labels=[f"{k:g}" for k in n])
    left.tick_params(axis="x", which="minor", labelbottom=False)
    right.plot(LOADS, 1 - LOADS, "k-", lw=1, label="theory")
    right.plot(LOADS, results["soft"], "o", ms=4, label="softest mode of the rod")
    right.axhline(0, color="k", ls=":", lw=1)
    right.set(xlabel="load over Euler's", ylabel="stiffness over that without load")
    for panel in (left, right):
        panel.legend(frameon=False, fontsize=8)
    save(figure, path)
