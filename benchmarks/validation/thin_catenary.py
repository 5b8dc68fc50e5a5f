"""A rope and a sheet hang between two supports: a catenary. Found by implicit steps."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, in_float64, save
from benchmarks.validation.thin_common import settled
from rewax.physics import thin

CELLS = {"tiny": 10, "small": 20, "full": 40}
LENGTH, SPAN, STIFFNESS = 1.0, 0.8, 1e4


def catenary(points: np.ndarray) -> np.ndarray:
    """Sag below the ends at points across the span, of an inextensible chain."""
    low, high = 1e-3, 1e3
    for _ in range(200):  # 2 a sinh(span / 2 a) = length, falling in a
        a = np.sqrt(low * high)
        low, high = (a, high) if 2 * a * np.sinh(min(SPAN / (2 * a), 700.0)) > LENGTH else (low, a)
    return a * (np.cosh(SPAN / (2 * a)) - np.cosh((points - SPAN / 2) / a))


def slack(vertices: np.ndarray) -> np.ndarray:
    x = np.array(vertices) * [SPAN, 1.0, 1.0]
    x[:, 1] -= 0.25 * np.sin(np.pi * x[:, 0] / SPAN)
    return x


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Shapes of both, and the largest error over the sag."""
    cells = CELLS[scale]
    line = thin.rope(np.linspace([0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0], cells + 1))
    sheet = thin.sheet(LENGTH, 0.1, cells, 1)
    cloth = thin.Cloth(warp=STIFFNESS, weft=STIFFNESS, shear=0.5 * STIFFNESS, bending=1e-4, density=0.5)
    rope = thin.Rope(stretch=STIFFNESS, density=0.1)
    found = {
        "rope": settled(slack(line.vertices), 200, mesh=line, rope=rope, held=[0, cells]),
        "sheet": settled(slack(sheet.vertices), 200, mesh=sheet, cloth=cloth, held=[0, 1, 2 * cells, 2 * cells + 1]),
    }
    checks = []
    for name, x in found.items():
        sag = catenary(x[:, 0])
        error = float(np.abs(-x[:, 1] - sag).max() / sag.max())
        checks.append(
            Check(
                what=f"{name}: sag of the middle; largest error over the sag",
                measured=float(-x[:, 1].min()),
                theory=float(sag.max()),
                unit="m",
                error=error,
                bar={"tiny": 0.03, "small": 0.02, "full": 0.005}[scale],
            )
        )
    return {"checks": checks, **found}


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, panel = plt.subplots(figsize=(5, 3.4))
    s = np.linspace(0, SPAN, 200)
    panel.plot(s, -catenary(s), "k-", lw=1, label="catenary")
    for name, style in (("rope", "o"), ("sheet", "x")):
        x = results[name]
        panel.plot(x[:, 0], x[:, 1], style, ms=4, label=name)
    panel.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    panel.legend(frameon=False, fontsize=8)
    save(figure, path)
