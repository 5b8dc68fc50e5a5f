"""iLQR of ``examples/ilqr.py`` beside TrajOpt and SAPO: returns and seconds at scale ``small``.

    python benchmarks/model_predictive.py --seeds 3
    python benchmarks/model_predictive.py --report | python benchmarks/page_tables.py docs/mpc.md

Rows of iLQR are those of ``docs/suites/mpc/results.csv``; a second call goes on where the first stopped. An episode of
iLQR is one start, seconds are those of planning and acting, with compiled programs. The other rows are those of the
comparison of algorithms, ``docs/suites/small/results.csv``: returns are means of many starts, seconds are those of the
whole run, with compilation and evaluation.
"""

import argparse
import os
import sys
from pathlib import Path

import rows as stored

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples"))
RESULTS, OTHERS = (ROOT / "docs/suites" / name / "results.csv" for name in ("mpc", "small"))
COLUMNS = ("task", "horizon", "seed", "return", "seconds", "cpus", "load")
HORIZONS = {"RollingFlat": 12, "FluidMove": 5}
"""Control steps of a plan."""
_NAMES = {"trajopt": "TrajOpt", "sapo": "SAPO", "no action": "no action"}


def run(task: str, seed: int) -> dict[str, object]:
    """An episode of iLQR."""
    import ilqr

    earned, seconds = ilqr.main(ilqr.Args(env=task, horizon=HORIZONS[task], seed=seed))
    return {
        "task": task, "horizon": HORIZONS[task], "seed": seed, "return": f"{earned:.3f}", "seconds": f"{seconds:.1f}",
        "cpus": os.cpu_count(), "load": f"{os.getloadavg()[0]:.1f}",
    }  # fmt: skip


def report(own: list[dict[str, str]], others: list[dict[str, str]]) -> str:
    """The table of all rows, by task."""
    lines = ["| task | method | return of an episode | seconds |", "|---|---|---|---|"]
    for task, horizon in HORIZONS.items():
        mine = [row for row in own if row["task"] == task]
        if mine:
            name = f"iLQR, {horizon} steps ahead, {_seeds(mine)}"
            lines.append(f"| {task} | {name} | {_range(mine, 'return')} | {_range(mine, 'seconds', 0)}, acting |")
        for algorithm, label in _NAMES.items():
            theirs = [row for row in others if (row["task"], row["algorithm"]) == (task, algorithm)]
            if theirs:
                trained = algorithm != "no action"
                seconds = f"{_range(theirs, 'wall_seconds', 0)}, training" if trained else ""
                name = f"{label}, {_seeds(theirs)}" if trained else label
                lines.append(f"| {task} | {name} | {_range(theirs, 'deterministic')} | {seconds} |")
    return "\n".join(lines)


def _seeds(rows: list[dict[str, str]]) -> str:
    return f"{len(rows)} seed{'s' if len(rows) > 1 else ''}"


def _range(rows: list[dict[str, str]], column: str, digits: int = 1) -> str:
    ends = [f"{end:.{digits}f}" for end in (f([float(row[column]) for row in rows]) for f in (min, max))]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--tasks", nargs="+", default=list(HORIZONS), choices=list(HORIZONS))
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--report", action="store_true")
    args = parser.parse_args()
    if args.report:
        print(report(stored.read(args.out), stored.read(OTHERS)))
        return
    from rewax.training import enable_compilation_cache

    enable_compilation_cache()
    done = {(row["task"], int(row["seed"])) for row in stored.read(args.out)}
    for seed in range(args.seeds):
        for task in args.tasks:
            if (task, seed) not in done:
                row = run(task, seed)
                stored.append([row], COLUMNS, args.out)
                print(row, flush=True)


if __name__ == "__main__":
    main()
