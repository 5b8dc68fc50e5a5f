"""``rewax identify``: physical parameters of an environment from a record, with their uncertainty."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from rewax.agents.legal import Count, Natural, Seed
from rewax.cli.options import Imports, import_modules, parse
from rewax.cli.record import task
from rewax.cli.train import quiet
from rewax.envs.registry import recipe
from rewax.whole_files import check_can_write

Unknowns: TypeAlias = tyro.conf.UseAppendAction[
    Annotated[tuple[str, ...], tyro.conf.arg(name="unknown", metavar="PARAMETER=LOW,HIGH")]
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      record: .npz file of ``rewax record``, or of your own, see the manual's page on identification.
      env: name of the environment, see ``rewax envs``.
      scale: ``small`` or ``paper``.
      unknowns: parameter=low,high, repeated: the range of its prior, uniform in the logarithm if low is above 0. The
        parameter alone stands for a decade around its present value. youngs_modulus stands for the one parameter whose
        name ends so.
      num_substeps: substeps of a control step; 0: those of the environment. Stiffer materials need more.
      body: particles fill the body of the first cloud, not that of the environment. ``height``: everything between the
        floor and the highest points; ``hull``: the convex hull of the points and of their shadow on the floor.
      cells: cells per metre of the grid. Of several, rising, each is fitted, and their difference is part of the
        interval. By default the environment's grid.
      limit: with several --cells: spacing of the grid to which the result is extrapolated [m]; 0: matter.
      starts: starts of the search.
      iterations: of the whole horizon.
      noise: smallest standard deviation of a seen point [m].
      seed: of the starts.
      out: JSON file of the result; by default beside the record.
      picture: draw the fit beside the result.
      video: write a video of what was seen beside the simulation, with this many frames a second; 0: none.
      imports: module or .py file that registers environments.
    """

    record: tyro.conf.Positional[str]
    env: str
    scale: str = "small"
    unknowns: Unknowns = ()
    num_substeps: Natural = 0
    body: Literal["height", "hull"] | None = None
    cells: tuple[float, ...] = ()
    limit: float | None = None
    starts: Count = 6
    iterations: Count = 12
    noise: float = 0.002
    seed: Seed = 0
    out: str | None = None
    picture: bool = True
    video: Natural = 4
    imports: Imports = ()


def run(argv: Sequence[str]) -> int:
    """Fit, print a table and sentences, write a JSON file and a picture.

    Raises:
      ValueError: a bad record, environment or unknown; one sentence.
    """
    from rewax.identify import identify, load
    from rewax.identify.picture import draw
    from rewax.training.evaluation.pictures import attempt
    from rewax.training.storage.cache import enable_compilation_cache

    quiet()
    options = parse(Options, argv, prog="rewax identify", description="Find physical parameters from a record.")
    import_modules(options.imports)
    out = Path(options.out) if options.out else Path(options.record).with_suffix(".json")
    if out.suffix != ".json":
        raise ValueError(f"--out is {options.out}: give a file .json, since pictures of the same name lie beside it")
    check_can_write(out)
    record = load(options.record)
    enable_compilation_cache()
    env = task(options.env, options.scale, options.num_substeps)
    console = Console(highlight=False, markup=False)
    found = identify(
        grids(env, record, options), record, priors(options.unknowns, env), starts=options.starts,
        max_iterations=options.iterations, noise=options.noise, seed=options.seed, limit=options.limit,
        progress=console.print,
    )  # fmt: skip
    found = dataclasses.replace(found, made_by=recipe(env))
    _print(console, found)
    console.print(f"wrote {found.save(out)}")
    if options.picture:
        console.print(f"wrote {draw(found, record, out.with_suffix('.png'))}")
    if options.video:
        console.print(attempt(out.with_suffix(".mp4"), functools.partial(_film, found, record, options.video)))
    return 0


def grids(env: Any, record: Any, options: Options) -> list[Any]:
    """The environment on each grid, with the body of the first cloud if that is asked for.

    Raises:
      ValueError: cells do not rise, or there is a limit with fewer than two; the body or a grid cannot be made.
    """
    from rewax.identify import with_body, with_cells

    if list(options.cells) != sorted(set(options.cells)):
        raise ValueError(f"--cells is {' '.join(map(str, options.cells))}: give rising numbers, the finest last")
    if options.limit is not None and len(options.cells) < 2:
        raise ValueError(f"--limit is {options.limit:g} with fewer than two grids: give --cells, for example 24 36")
    envs = [with_cells(env, cells) for cells in options.cells] or [env]
    if options.body is None:
        return envs
    cloud = record.clouds[0][record.mask[0]]
    return [with_body(one, cloud, kind=options.body) for one in envs]


def priors(unknowns: Sequence[str], env: Any) -> dict[Any, Any]:
    """Priors from ``parameter=low,high`` and ``parameter`` texts.

    Raises:
      ValueError: there are none, or one cannot be read; the environment has no such parameter.
    """
    from rewax.envs.randomize import LogUniform, Uniform, leaves
    from rewax.training.evaluation.sweep import read_grid

    if not unknowns:
        raise ValueError("give at least one --unknown: --unknown youngs_modulus=200,3000")
    found: dict[Any, Any] = {}
    known = leaves(env)
    for text in unknowns:
        ranged = text if "=" in text else f"{text}=1,2"
        try:
            ((name, ends),) = read_grid([ranged], env).items()
        except ValueError as error:
            raise ValueError(str(error).replace("--set", "--unknown")) from None
        if "=" not in text:
            if name not in known or np.ndim(known[name]) > 0:
                raise ValueError(f"{name} is not one number, around which there is a decade: give {text}=LOW,HIGH")
            value = float(known[name])
            if not value > 0.0:
                raise ValueError(f"{name} is {value:g}, around which there is no decade: give {text}=LOW,HIGH")
            ends = (value / math.sqrt(10.0), value * math.sqrt(10.0))
        if len(ends) != 2 or name in found:
            raise ValueError(f"--unknown is {text!r}: give each parameter once, as parameter=low,high")
        found[name] = LogUniform(*ends) if ends[0] > 0.0 else Uniform(*ends)
    return found


def _film(found: Any, record: Any, rate: int, path: Path) -> str:
    from rewax.identify.film import film
    from rewax.viz.video import write_video

    size = (420, 960)
    write_video(film(found, record, size=size), path, rate=rate, size=size)
    return ""


def _print(console: Console, found: Any) -> None:
    table = Table(box=None, pad_edge=False)
    for title in ("unknown", "value", "95 % interval", "of the prior's std"):
        table.add_column(title)
    for row in found.table():
        table.add_row(*row)
    console.print(table)
    for sentence in (*found.undetermined, *found.remarks):
        console.print(sentence)
    worst = int(found.residual_by_frame.argmax())
    console.print(
        f"Seen points lie {1e3 * found.residual_by_frame.mean():.2f} mm from the simulated surface (root mean square), "
        f"{1e3 * found.residual_by_frame[worst]:.2f} mm at {found.times[worst]:.3g} s. It took {found.seconds:.0f} s."
    )


__all__ = ["Options", "grids", "priors", "run"]
