"""``rewax plot``: learning curves of several runs in one picture, the mean over seeds and each seed as a thin line."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from rewax.cli.options import names_of, parse
from rewax.statistics import Curve, learning_curve

_FORMATS = (".png", ".svg", ".pdf")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      runs: directories of runs; runs with the same algorithm, environment and scale are seeds of one curve.
      out: picture to write; its ending, .png, .svg or .pdf, chooses the format.
      by: config: one curve per algorithm, environment and scale; run: one curve per run.
      title: title of the picture.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    out: str = "curves.png"
    by: str = "config"
    title: str = ""


def run(argv: Sequence[str]) -> int:
    """Draw the curves and print the path of the picture.

    Raises:
      ValueError: no runs, a directory without ``metrics.csv``, an unknown ending; one sentence.
    """
    from rewax.viz.curves import curves_of_seeds

    options = parse(Options, argv, prog="rewax plot", description="Compare the learning curves of runs.")
    if not options.runs:
        raise ValueError("rewax plot needs one or more run directories: rewax plot runs/*")
    if options.by not in ("config", "run"):
        raise ValueError(f"--by is {options.by!r}: use config (seeds of one configuration make a curve) or run")
    out = Path(options.out)
    if out.suffix not in _FORMATS:
        raise ValueError(f"{options.out} does not end in {', '.join(_FORMATS)}: choose one of these")
    curves: dict[str, list[Curve]] = {}
    for directory, own in zip(options.runs, names_of(options.runs), strict=True):
        name, curve = _curve(Path(directory), own if options.by == "run" else "")
        curves.setdefault(name, []).append(curve)
        if not curve.steps.size:
            print(f"note: no episode of {directory} has ended, so it has no curve")
    out.parent.mkdir(parents=True, exist_ok=True)
    print(f"wrote {curves_of_seeds(curves, out, title=options.title)}")
    return 0


def _curve(directory: Path, name: str) -> tuple[str, Curve]:
    """Name and curve of a run; its name is that of its configuration if ``name`` is empty."""
    from rewax.training.storage.description import read_config
    from rewax.training.storage.metrics import read_csv

    path = directory / "metrics.csv"
    if not path.is_file():
        raise ValueError(
            f"{directory} holds no metrics.csv: give the directories of runs, runs/RollingFlat-small-0 say"
        )
    columns = read_csv(path)
    begun = "\n" in path.read_text(errors="replace")
    if begun and (missing := [name for name in ("env_steps", "return") if name not in columns]):
        raise ValueError(f"{path} has no column {missing[0]}: it was not written by a training run")
    if name:
        return name, learning_curve(columns)
    config = read_config(directory)
    parts = [str(config[name]) for name in ("agent", "env", "scale") if config.get(name)]
    return " ".join(parts) or directory.name, learning_curve(columns)
