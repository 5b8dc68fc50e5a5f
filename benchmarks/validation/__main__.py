"""Run cases, print what they found beside what theory says, draw a picture of each; exit code 1 if one fails."""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated

import matplotlib
import tyro

from benchmarks.validation import CASES
from benchmarks.validation.common import SCALES, Check
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Compare simulations with theory and experiments."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Cases to run; none for all."""
    scale: str = "full"
    """tiny (as in the tests), small (seconds per case) or full (minutes)."""
    out: Path | None = None
    """Directory for the pictures, one for each case; none are drawn without."""


def print_row(case: str, check: Check) -> None:
    verdict = "" if check.passed else "  FAILS"
    print(
        f"{case:14s} {check.what:58s} {check.measured:12.5g} {check.theory:12.5g} {check.unit:6s}"
        f" {check.error:9.2g} {check.bar:7.2g} {check.error_unit}{verdict}",
        flush=True,
    )


def main(args: Args) -> int:
    unknown = sorted(set(args.names) - set(CASES))
    if unknown:
        raise SystemExit(f"there is no case {', '.join(unknown)}: choose from {', '.join(CASES)}")
    if args.scale not in SCALES:
        raise SystemExit(f"scale is {args.scale}: choose from {', '.join(SCALES)}")
    matplotlib.use("Agg")
    enable_compilation_cache()
    print(f"{'case':14s} {'quantity':58s} {'measured':>12s} {'theory':>12s} {'unit':6s} {'error':>9s} {'bar':>7s}")
    failed = False
    for name in args.names or tuple(CASES):
        began = time.perf_counter()
        results = CASES[name].run(args.scale)
        for check in results["checks"]:
            print_row(name, check)
            failed |= not check.passed
        print(f"{name:14s} {time.perf_counter() - began:.0f} s", flush=True)
        if args.out is not None:
            args.out.mkdir(parents=True, exist_ok=True)
            CASES[name].plot(results, args.out / f"{name}.png")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
