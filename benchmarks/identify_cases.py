"""Synthetic cases of ``rewax.identify``: a dough of unknown numbers, pushed once before a camera.

    python benchmarks/identify_cases.py --cases 100   # rows of docs/suites/identify/results.csv
    python benchmarks/identify_cases.py --report

A second call goes on where the first stopped. True numbers are drawn from priors a decade wide. The world that makes
the record has a finer grid, other and more particles than the fit's: 36 cells a metre instead of 24 and 28, 2592
particles instead of 1176. The camera sees them with 2 mm of noise, and 30 % of what it sees is hidden. The floor lies
on a node of all grids.
"""

import argparse
import csv
import os
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rewax
from rewax.envs.kit.soft_parts import box_walls, lattice_box
from rewax.envs.randomize import LogUniform
from rewax.identify import identify, record
from rewax.physics import mpm
from rewax.training import enable_compilation_cache

RESULTS = Path(__file__).resolve().parent.parent / "docs/suites/identify/results.csv"
MODULUS, YIELD = "scene.material.elasticity.youngs_modulus", "scene.material.plasticity.yield_stress"
PRIORS = {MODULUS: LogUniform(300.0, 3000.0), YIELD: LogUniform(8.0, 80.0)}
SIZE, FLOOR = (0.3, 0.125, 0.3), 1.0 / 12.0
NOISE, OCCLUSION, STEPS_DOWN, STEPS_UP = 0.002, 0.3, 12, 4
_COLUMNS = (
    "case",
    "unknown",
    "true",
    "found",
    "low",
    "high",
    "left",
    "residual_mm",
    "failed",
    "seconds",
    "cpus",
    "load",
    "remarks",
)


def dough(cells: int, counts: tuple[int, int, int], num_substeps: int, shake: float = 0.0, seed: int = 0) -> Any:
    """RollingFlat's dough and pin on a grid of ``cells`` a metre.

    Args:
      cells: a metre.
      counts: particles along each axis.
      num_substeps: of a control step.
      shake: displacement of particles in cells of their lattice; 0: a lattice.
      seed: of the displacement.
    """
    env: Any = rewax.make("RollingFlat", scale="small", num_substeps=num_substeps)
    rest = np.asarray(lattice_box((0.5, FLOOR + 0.5 * SIZE[1], 0.5), SIZE, counts))
    generator = np.random.Generator(np.random.PCG64(seed))
    rest = rest + shake * generator.uniform(-0.5, 0.5, rest.shape) * np.asarray(SIZE) / np.asarray(counts)
    spacing = 1.0 / cells
    low, reach = np.array([0.0625, FLOOR - 2.0 * spacing, 0.125]), np.array([0.9, 0.36, 0.76])
    grid = mpm.Grid(shape=tuple(int(np.ceil(r * cells)) for r in reach), spacing=spacing, origin=tuple(low))
    scene = mpm.make_scene(
        grid=grid, dt=env.scene.dt, material=env.scene.material, particle_volume=float(np.prod(SIZE)) / len(rest),
        gravity=(0.0, -90.0, 0.0), colliders=env.scene.colliders,
        walls=box_walls(floor=FLOOR, lower=(0.15, 0.25), upper=(0.85, 0.75)),
    )  # fmt: skip
    rise = jnp.asarray([0.0, FLOOR - 0.0625, 0.0])
    return env.replace(
        scene=scene, rest_positions=jnp.asarray(rest, jnp.float32), joint_start=env.joint_start + rise,
        joint_lower=env.joint_lower + rise, joint_upper=env.joint_upper + rise,
    )  # fmt: skip


def push() -> np.ndarray:
    """The pin goes down by 4.8 cm and along by 9.6 cm, and rises a little: actions, shape (16, 3)."""
    down, up = np.tile([0.3, -1.0, 0.0], (STEPS_DOWN, 1)), np.tile([0.3, 1.0, 0.0], (STEPS_UP, 1))
    return np.concatenate([down, up]).astype(np.float32)


def truth_of(case: int) -> tuple[float, float]:
    """True modulus and yield stress [Pa]: draws from the priors."""
    generator = np.random.Generator(np.random.PCG64(1000 + case))
    return tuple(float(np.exp(generator.uniform(np.log(p.low), np.log(p.high)))) for p in PRIORS.values())  # type: ignore[return-value]


def run_case(case: int, fit: Any, verbose: bool = False) -> list[dict[str, Any]]:
    """Rows of one case."""
    true = dict(zip(PRIORS, truth_of(case), strict=True))
    world = dough(36, (18, 8, 18), 30, shake=0.9, seed=case)
    for name, value in true.items():
        world = rewax.replace_leaf(world, name, value)
    seen = record(world, push(), jax.random.key(case), every=2, noise=NOISE, occlusion=OCCLUSION, num_points=384)
    began = time.perf_counter()
    found = identify(fit, seen, PRIORS, seed=0, noise=NOISE, progress=print if verbose else None)
    seconds = time.perf_counter() - began
    if verbose:
        print(
            found.values,
            found.undetermined,
            found.remarks,
            1e3 * found.residual_by_frame,
            found.starts,
            found.costs,
            sep="\n",
        )
    residual = 1e3 * float(np.sqrt((found.residual_by_frame[1:] ** 2).mean()))
    rows = []
    for i, name in enumerate(PRIORS):
        low, high = found.intervals[name]
        numbers = (true[name], found.values[name], low, high)
        told = (f"{residual:.3f}", found.failed, f"{seconds:.1f}", os.cpu_count(), f"{os.getloadavg()[0]:.1f}")
        left = f"{float(np.sqrt(found.covariance[i, i])):.4f}"
        remarks = " ".join(found.remarks + found.undetermined)
        row = (case, name.split(".")[-1], *(f"{number:.5g}" for number in numbers), left, *told, remarks)
        rows.append(dict(zip(_COLUMNS, row, strict=True)))
    return rows


def read_rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(path: Path, rows: list[dict[str, Any]]) -> None:
    new = not path.is_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)


def report(rows: list[dict[str, str]]) -> str:
    """A table of how close and how certain: shares of cases."""
    lines = [
        "| unknown | cases | median error | within 10 % | truth in the 95 % interval | determined | median seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(row["unknown"] for row in rows):
        own = [row for row in rows if row["unknown"] == name]
        true, found, low, high = (np.array([float(row[c]) for row in own]) for c in ("true", "found", "low", "high"))
        error = np.abs(found / true - 1.0)
        inside = (low <= true) & (true <= high)
        determined = np.array([float(row["left"]) for row in own]) <= 0.5
        seconds = np.median([float(row["seconds"]) for row in own])
        counts = f"{np.sum(error < 0.1)} | {inside.sum()} | {determined.sum()}"
        lines.append(f"| {name} | {len(own)} | {100 * np.median(error):.0f} % | {counts} | {seconds:.0f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    if args.report:
        print(report(read_rows(args.out)))
        return
    enable_compilation_cache()
    done = {int(row["case"]) for row in read_rows(args.out)}
    fit = [dough(24, (14, 6, 14), 20), dough(28, (14, 6, 14), 24)]
    for case in range(args.first, args.cases):
        if case in done:
            continue
        rows = run_case(case, fit, args.verbose)
        append(args.out, rows)
        for r in rows:
            said = f"{r['case']:3d} {r['unknown']:15s} true {r['true']:>8s} found {r['found']:>8s}"
            print(f"{said} [{r['low']}, {r['high']}] {r['seconds']} s", flush=True)


if __name__ == "__main__":
    main()
