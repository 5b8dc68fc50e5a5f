"""Synthetic cases of ``rewax.identify``: a body of unknown numbers, pushed once before a camera.

    python benchmarks/identify_cases.py --cases 20   # of each kind: rows of docs/suites/identify/results.csv
    python benchmarks/identify_cases.py --report

A second call goes on where the first stopped. True numbers are drawn from priors a decade wide. The world that makes
the record has 48 cells a metre and particles at random places, 1.25 cm apart; the fits have 24 and 36 cells a metre and
particles 2.13 and 1.63 cm apart. The result is extrapolated to the world's spacing; that of real matter is 0. The
camera has 2 mm of noise, and 30 % of what it sees is hidden. A second push is not fitted: the surface of the identified
simulation is compared with the world's, beside those with the priors' medians and with the true numbers.
"""

import argparse
import functools
import os
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import rows as stored
from identify_worlds import KINDS, Kind, world

from rewax.identify import identify, record
from rewax.identify.records import Record
from rewax.identify.simulate import Data, data_of, simulated_frames, without_reset_noise
from rewax.identify.surface import particle_spacing, surface_offsets, surface_residuals
from rewax.identify.unknowns import Space, space_of
from rewax.training import enable_compilation_cache

RESULTS = Path(__file__).resolve().parent.parent / "docs/suites/identify/results.csv"
WORLD, COARSE, FINE = (48, 0.0125), (24, 0.0213), (36, 0.0163)
"""Cells a metre, and spacing of the particles [m]."""
NOISE, OCCLUSION, POINTS, STARTS = 0.002, 0.3, 384, 5
COLUMNS: tuple[str, ...] = (
    "kind", "case", "unknown", "true", "found", "low", "high", "left", "finest", "residual_mm", "held_out_mm",
    "held_out_prior_mm", "held_out_true_mm", "failed", "seconds", "cpus", "load", "remarks", "held_out_finest_mm",
    "cpu_seconds",
)  # fmt: skip

_HALFWAY = "{} leaves its prior on the coarsest grid"
"""Begin of the remark on a value that lies halfway between that of the finest grid and the extrapolated one."""
_PREDICTED = ("held_out_mm", "held_out_prior_mm", "held_out_true_mm", "held_out_finest_mm")


def run_case(name: str, case: int, verbose: bool = False) -> list[dict[str, Any]]:
    """Rows of one case, one for each unknown."""
    kind = KINDS[name]
    fits = [world(kind, *COARSE), world(kind, *FINE)]
    real = space_of(kind.priors, fits[-1])
    real = real.place(world(kind, *WORLD, shake=0.9, seed=case), latent_of(real, kind.truth(case)))
    see = functools.partial(record, real, key=jax.random.key(case), every=2, num_points=POINTS)
    seen, held_out = see(kind.actions(), noise=NOISE, occlusion=OCCLUSION), see(kind.actions(held_out=True))
    return rows_of(kind, (name, case), fits, (seen, held_out), limit=1.0 / WORLD[0], verbose=verbose)


def rows_of(
    kind: Kind, labels: tuple[str, int], fits: list[Any], records: tuple[Record, Record], *, limit: float, verbose: bool
) -> list[dict[str, Any]]:
    """Rows of a fit to the first record, the second one predicted.

    Args:
      kind: of the world, with the priors and the true numbers.
      labels: name of the kind and number of the case.
      fits: the coarse environment and the fine one.
      records: of the fitted push and of the one that is held out.
      limit: see ``identify`` [m].
      verbose: print the iterations and what was found.
    """
    true, (seen, held_out), space = kind.truth(labels[1]), records, space_of(kind.priors, fits[-1])
    began, busy = time.perf_counter(), time.process_time()
    found = identify(
        fits, seen, kind.priors, noise=NOISE, starts=STARTS, limit=limit, progress=print if verbose else None
    )
    seconds, busy = time.perf_counter() - began, time.process_time() - busy
    if verbose:
        print(found.values, found.undetermined, found.remarks, 1e3 * found.residual_by_frame, found.starts, found.costs)
    finest = space.numbers(found.starts[-(STARTS // 2) :].mean(0))
    choices = (found.values, kind.median(), true, dict(zip(space.labels, finest, strict=True)))
    predicted = _errors(fits[-1], space, held_out, choices)
    told = {
        "kind": labels[0], "case": labels[1],
        "residual_mm": f"{1e3 * _root_mean_square(found.residual_by_frame[1:]):.3f}",
        **{column: f"{1e3 * error:.3f}" for column, error in zip(_PREDICTED, predicted, strict=True)},
        "failed": found.failed, "seconds": f"{seconds:.1f}", "cpu_seconds": f"{busy:.1f}", "cpus": os.cpu_count(),
        "load": f"{os.getloadavg()[0]:.1f}", "remarks": " ".join(found.remarks + found.undetermined),
    }  # fmt: skip
    rows = []
    for i, unknown in enumerate(kind.priors):
        low, high = found.intervals[unknown]
        numbers = {"true": true[unknown], "found": found.values[unknown], "low": low, "high": high, "finest": finest[i]}
        left = f"{float(np.sqrt(found.covariance[i, i])):.4f}"
        own = {"unknown": unknown.split(".")[-1], "left": left, **{n: f"{v:.5g}" for n, v in numbers.items()}}
        rows.append({**told, **own})
    return rows


def _errors(env: Any, space: Space, held_out: Record, choices: tuple[dict[str, float], ...]) -> list[float]:
    """Root mean square distance of a record from the simulated surface, for each choice of numbers [m]."""
    env = without_reset_noise(env)
    data = data_of(held_out, 0.5 * particle_spacing(np.asarray(env.rest_positions)), 1)
    return [_root_mean_square(_distances(env, latent_of(space, chosen), data, space=space)) for chosen in choices]


@functools.partial(jax.jit, static_argnames="space")
def _distances(env: Any, latent: jax.Array, data: Data, *, space: Space) -> jax.Array:
    """Root mean square by frame, the first left out [m], shape (num_frames - 1,)."""
    frames, _ = simulated_frames(env, space, latent, data)
    offsets = surface_offsets(frames[0], data.clouds[0], data.mask[0], data.width)

    def of_frame(frame: tuple[jax.Array, ...]) -> jax.Array:
        particles, cloud, mask = frame
        square = surface_residuals(particles, cloud, data.width, offsets) ** 2
        return jnp.sqrt(jnp.sum(jnp.where(mask, square, 0.0)) / jnp.sum(mask))

    return jax.lax.map(of_frame, (frames, data.clouds, data.mask))[1:]


def latent_of(space: Space, numbers: dict[str, float]) -> jax.Array:
    return jnp.asarray(space.latent([numbers[label] for label in space.labels]), jnp.float32)


def _root_mean_square(values: Any) -> float:
    return float(np.sqrt((np.asarray(values) ** 2).mean()))


def report(rows: list[dict[str, str]]) -> str:
    """Tables: how close and how certain the numbers are; how well pushes are predicted that were not fitted; totals."""
    lines = [
        "| world | unknown | cases | median error | of the finest grid alone | within 10 % "
        "| truth in the 95 % interval | determined | halfway | median seconds | of CPU time |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    pairs = dict.fromkeys((row["kind"], row["unknown"]) for row in rows)
    for pair in pairs:
        own = [row for row in rows if (row["kind"], row["unknown"]) == pair]
        true, found, low, high, finest = (_column(own, c) for c in ("true", "found", "low", "high", "finest"))
        error = np.abs(found / true - 1.0)
        counts = (
            f"{np.sum(error < 0.1)} | {np.sum((low <= true) & (true <= high))} | {np.sum(_column(own, 'left') <= 0.5)} "
            f"| {sum(_HALFWAY.format(pair[1]) in row['remarks'] for row in own)}"
        )
        medians = f"{100 * np.median(error):.0f} % | {100 * np.median(np.abs(finest / true - 1.0)):.0f} %"
        times = f"{np.median(_column(own, 'seconds')):.0f} | {_known_median(own, 'cpu_seconds', '.0f')}"
        lines.append(f"| {pair[0]} | {pair[1]} | {len(own)} | {medians} | {counts} | {times} |")
    lines += [
        "", "| world | held-out push: identified | prior's median | true numbers | of the finest grid alone |",
        "|---|---|---|---|---|",
    ]  # fmt: skip
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = list({row["case"]: row for row in rows if row["kind"] == kind}.values())
        lines.append(
            f"| {kind} | " + " | ".join(_known_median(own, column, ".1f", " mm") for column in _PREDICTED) + " |"
        )
    return "\n".join([*lines, "", *_totals(rows)])


def _totals(rows: list[dict[str, str]]) -> list[str]:
    """A table of one row: counts over all worlds."""
    cases = {(row["kind"], row["case"]): row for row in rows}.values()
    true, found, low, high = (_column(rows, c) for c in ("true", "found", "low", "high"))
    better = sum(float(row["held_out_mm"]) < float(row["held_out_prior_mm"]) for row in cases)
    counts = (len(cases), len(rows), np.sum(np.abs(found / true - 1.0) < 0.1), np.sum((low <= true) & (true <= high)))
    seconds = np.median([float(row["seconds"]) for row in cases])
    return [
        "| cases | estimates | within 10 % | truth in the 95 % interval | held-out push better than with the prior's "
        "median | median seconds of a case |",
        "|---|---|---|---|---|---|",
        "| " + " | ".join(str(n) for n in (*counts, f"{better} cases", f"{seconds:.0f}")) + " |",
    ]


def _known_median(rows: list[dict[str, str]], column: str, form: str, unit: str = "") -> str:
    """The median, a dash where no row tells it."""
    known = [row for row in rows if row.get(column)]
    return f"{np.median(_column(known, column)):{form}}{unit}" if known else "-"


def _column(rows: list[dict[str, str]], name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=20, help="of each kind")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    if args.report:
        print(report(stored.read(args.out)))
        return
    enable_compilation_cache()
    done = {(row["kind"], int(row["case"])) for row in stored.read(args.out)}
    for case in range(args.first, args.cases):
        for name in args.kinds:
            if (name, case) in done:
                continue
            rows = run_case(name, case, args.verbose)
            stored.append(rows, COLUMNS, args.out)
            for r in rows:
                said = f"{name:8s} {case:3d} {r['unknown']:15s} true {r['true']:>8s} found {r['found']:>8s}"
                print(f"{said} [{r['low']}, {r['high']}] {r['seconds']} s", flush=True)


if __name__ == "__main__":
    main()
