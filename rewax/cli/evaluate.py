"""``rewax eval``: returns of a trained policy, with sampled and with deterministic actions, also over parameters."""

import dataclasses
import errno
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from rewax.agents.legal import Count, Natural, Seed
from rewax.cli.options import Imports, import_modules, one_of, parse
from rewax.cli.train import quiet
from rewax.whole_files import replacing

_MODES = {"sampled": False, "deterministic": True}
_Settings = tyro.conf.UseAppendAction[
    Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="PARAMETER=V1,V2,...")]
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      run: directory of the run, or name of a task with a packaged policy.
      run_dir: the same, as an option.
      scale: of a task given by name; by default what suits the device.
      imports: module or .py file that registers environments or algorithms.
      episodes: number of episodes, from random initial states.
      seed: draws the initial states; the same seed gives the same ones for every policy.
      step: iteration of the checkpoint, the newest by default.
      settings: evaluate in environments with these values of a physical parameter, and print a table; repeated, all
        combinations. youngs_modulus stands for the one parameter whose name ends so.
      baselines: also evaluate doing nothing (all actions zero) and random actions, from the same initial states.
      json: file for the numbers; by default eval.json in the run's directory.
      video: record an episode with deterministic actions as a video.
      video_path: .mp4 file of the video; by default episode.mp4 in the run's directory, or <task>.mp4 in
        the working directory.
      video_size: width and height of the video in pixels, even numbers.
      color_by: colours of particles in the video: material, height, or a value of the environment (speed, strain).
      surface: draw the surfaces of materials in the video; --no-surface draws particles as balls.
    """

    run: tyro.conf.Positional[str | None] = None
    run_dir: str | None = None
    scale: str | None = None
    imports: Imports = ()
    episodes: Count = 64
    seed: Seed = 0
    step: Natural | None = None
    settings: _Settings = ()
    baselines: bool = False
    json: str | None = None
    video: bool = True
    video_path: str | None = None
    video_size: tuple[int, int] = (480, 360)
    color_by: str = "material"
    surface: bool = True


def run(argv: Sequence[str]) -> int:
    """Evaluate a run; print a line for each kind of actions, or a table over parameters; write JSON and a video.

    Raises:
      ValueError: there is no such run, checkpoint, environment or parameter, or an option cannot be; one sentence.
    """
    from rewax.training.evaluation.cameras import as_recorded
    from rewax.training.evaluation.recording import can_record, check_color_by
    from rewax.training.evaluation.sweep import read_grid
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.storage.policies import is_policy, open_run

    quiet()
    options = parse(Options, argv, prog="rewax eval", description="Evaluate a trained policy.")
    where = _checked(options)
    enable_compilation_cache()
    import_modules(options.imports)
    saved = open_run(where, step=options.step, scale=options.scale)
    env = as_recorded(saved.env)
    films = options.video and can_record(env)
    if films:
        check_color_by(env, options.color_by)
    grid = read_grid(options.settings, saved.env)
    iteration = int(saved.train_state.iteration)
    print(f"{saved.config['agent']} on {saved.config.get('env', 'an unregistered environment')}, iteration {iteration}")
    found = {"run": str(where), "iteration": iteration, "episodes": options.episodes, "seed": options.seed}
    found |= {"grid": _print_grid(saved, grid, options)} if grid else _print_results(saved, options)
    folder = None if is_policy(where) else Path(where)
    if out := options.json or (folder and folder / "eval.json"):
        try:
            print(_write_json(Path(out), found))
        except OSError as error:  # a run of somebody else can be evaluated, too
            if options.json or error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
                raise
            print(f"warning: {out} was not written ({error.strerror}): --json names another file")
    if films:
        default = Path(f"{where}.mp4") if folder is None else folder / "episode.mp4"
        print(_film(saved, env, Path(options.video_path or default), options))
    return 0


def _checked(options: Options) -> str:
    """Check the options that need no loaded run; returns the directory or task to evaluate."""
    where = one_of(options.run, options.run_dir, "rewax eval needs one run directory or task: rewax eval HandFlip")
    if options.baselines and options.settings:
        raise ValueError("--baselines evaluates without --set: leave one of them out")
    if any(pixels < 2 or pixels % 2 for pixels in options.video_size):
        raise ValueError(f"video-size is {' '.join(map(str, options.video_size))}: give even numbers from 2 on")
    if not options.video:
        for name in ("video-path", "video-size", "color-by", "surface"):
            field = name.replace("-", "_")
            if getattr(options, field) != Options.__dataclass_fields__[field].default:
                option = f"--{'no-' * (name == 'surface')}{name}"
                raise ValueError(f"{option} is of a video, and --no-video makes none: leave one out")
    for name, ending in (("json", ".json"), ("video_path", ".mp4")):
        path = getattr(options, name)
        if path is None:
            continue
        if Path(path).suffix != ending or Path(path).is_dir() or not Path(path).parent.is_dir():
            raise ValueError(f"{name.replace('_', '-')} is {path}: give a file {ending} in a folder that exists")
    return where


def _print_results(saved: Any, options: Options) -> dict[str, Any]:
    """Evaluate in the run's own environment: a line for each kind of actions, with a 95 % bootstrap interval."""
    import jax
    import jax.numpy as jnp

    from rewax.training.evaluation.episodes import constant_policy, make_evaluate, uniform_policy

    env, found = saved.env, {}
    trained = make_evaluate(env, saved.agent.policy, options.episodes)
    evaluations = {name: (trained, deterministic) for name, deterministic in _MODES.items()}
    if options.baselines:
        still, random = constant_policy(jnp.zeros(env.action_spec.shape)), uniform_policy(env)
        evaluations["no action"] = make_evaluate(env, still, options.episodes), True
        evaluations["random actions"] = make_evaluate(env, random, options.episodes), False
    width = max(map(len, evaluations))
    for name, (evaluate, deterministic) in evaluations.items():
        key = jax.random.key(options.seed)
        numbers = found[name] = _numbers(evaluate(saved.train_state, key, deterministic=deterministic))
        low, high = numbers["interval"]
        spread = ", ".join(f"{what} {numbers[what]:.4g}" for what in ("std", "min", "max"))
        success = f", {numbers['success']:.0%} succeeded" if "success" in numbers else ""
        mean = f"mean {numbers['mean']:.4g} [{low:.4g}, {high:.4g}]"
        print(f"{name:{width}s} {mean}, {spread}{success}, {numbers['failed']} of {options.episodes} failed")
    return found


def _print_grid(saved: Any, grid: Any, options: Options) -> list[dict[str, Any]]:
    """Evaluate in environments with other parameters; prints a table."""
    import jax

    from rewax.training.evaluation.episodes import make_evaluate_in
    from rewax.training.evaluation.sweep import points, table, with_parameters

    evaluate, found = make_evaluate_in(saved.agent.policy, options.episodes), []
    for values in points(grid):
        env, key = with_parameters(saved.env, values), jax.random.key(options.seed)
        results = {
            name: _numbers(evaluate(env, saved.train_state, key, deterministic=deterministic))
            for name, deterministic in _MODES.items()
        }
        found.append({"parameters": values, **results})
    print(table([_row(point) for point in found]))
    return found


def _row(point: dict[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {name.rpartition(".")[2]: value for name, value in point["parameters"].items()}
    if len(row) < len(point["parameters"]):
        row = dict(point["parameters"])
    for name in _MODES:
        low, high = point[name]["interval"]
        row |= {name: point[name]["mean"], f"{name} 95 %": f"[{low:.4g}, {high:.4g}]"}
        row |= {f"{name} succeeded": f"{point[name]['success']:.0%}"} if "success" in point[name] else {}
    return {**row, "failed": sum(point[name]["failed"] for name in _MODES)}


def _numbers(result: Any) -> dict[str, Any]:
    """An evaluation as plain numbers, with the 95 % bootstrap interval of its mean."""
    import jax

    from rewax.statistics import bootstrap_interval

    result = jax.device_get(result)
    numbers = {name: value.item() for name, value in result.items() if value.ndim == 0}
    interval = [float(bound) for bound in bootstrap_interval(result["returns"])]
    return {**numbers, "interval": interval, "returns": result["returns"].tolist()}


def _write_json(path: Path, content: dict[str, Any]) -> str:
    with replacing(path) as unfinished:
        unfinished.write_text(json.dumps(content, indent=1) + "\n")
    return f"wrote {path}"


def _film(saved: Any, env: Any, path: Path, options: Options) -> str:
    """Record an episode and draw it; says where."""
    import jax

    from rewax.training.evaluation.pictures import attempt, draw_video
    from rewax.training.evaluation.recording import record

    def draw(path: Path) -> str:
        recording = record(env, saved.agent.policy, saved.train_state, jax.random.key(options.seed))
        width, height = options.video_size
        return draw_video(recording, path, size=(height, width), color_by=options.color_by, surface=options.surface)

    return attempt(path, draw)


__all__ = ["Options", "run"]
