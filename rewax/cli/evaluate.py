"""``rewax eval``: returns of a trained policy, with sampled and with deterministic actions."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from rewax.cli.options import Imports, import_modules, parse
from rewax.cli.train import quiet


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      run: directory of the run, or name of a task whose trained policy the package brings.
      run_dir: the same, as an option.
      scale: of a task given by name; by default what suits the device.
      imports: module or .py file that registers environments or algorithms.
      episodes: how many, from random starts.
      seed: draws the starts; the same seed gives the same ones to every policy.
      step: iteration of the checkpoint, the newest by default.
      video: record an episode with deterministic actions: episode.mp4 in the run's directory, or <task>.mp4 here.
      color_by: what colours particles in it: material, height, or what the environment offers (speed, strain).
      surface: show particles in it by the surfaces of their materials; --no-surface shows them as balls.
    """

    run: tyro.conf.Positional[str | None] = None
    run_dir: str | None = None
    scale: str | None = None
    imports: Imports = ()
    episodes: int = 64
    seed: int = 0
    step: int | None = None
    video: bool = True
    color_by: str = "material"
    surface: bool = True


def run(argv: Sequence[str]) -> int:
    """Evaluate a run and print a line for each kind of actions: the mean return with its 95 % bootstrap interval.

    Raises:
      ValueError: there is no such run, checkpoint or environment; one sentence.
    """
    import jax

    from rewax.statistics import bootstrap_interval
    from rewax.training.evaluation.episodes import make_evaluate
    from rewax.training.evaluation.pictures import attempt, draw_video
    from rewax.training.evaluation.recording import can_record, record
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.storage.policies import is_policy, open_run

    quiet()
    options = parse(Options, argv, prog="rewax eval", description="Evaluate what a run has learnt.")
    where = options.run or options.run_dir
    if where is None or (options.run and options.run_dir):
        raise ValueError("rewax eval needs one run directory or task: rewax eval HandFlip")
    if options.episodes < 1:
        raise ValueError(f"episodes is {options.episodes}: use 1 or more")
    enable_compilation_cache()
    import_modules(options.imports)
    saved = open_run(where, step=options.step, scale=options.scale)
    evaluate = make_evaluate(saved.env, saved.agent.policy, options.episodes)
    env_name = saved.config.get("env", "an environment of one's own")
    print(f"{saved.config['agent']} on {env_name}, iteration {int(saved.train_state.iteration)}")
    for name, deterministic in (("sampled", False), ("deterministic", True)):
        result = evaluate(saved.train_state, jax.random.key(options.seed), deterministic=deterministic)
        low, high = bootstrap_interval(jax.device_get(result["returns"]))
        numbers = ", ".join(f"{what} {float(result[what]):.4g}" for what in ("std", "min", "max"))
        success = f", {float(result['success']):.0%} succeeded" if "success" in result else ""
        mean = f"mean {float(result['mean']):.4g} [{low:.4g}, {high:.4g}]"
        print(f"{name:13s} {mean}, {numbers}{success}, {int(result['failed'])} of {options.episodes} failed")
    env = getattr(saved.env, "unwrapped", saved.env)
    if options.video and can_record(env):

        def draw(path: Path) -> str:
            recording = record(env, saved.agent.policy, saved.train_state, jax.random.key(options.seed))
            return draw_video(recording, path, color_by=options.color_by, surface=options.surface)

        print(attempt(Path(f"{where}.mp4") if is_policy(where) else Path(where) / "episode.mp4", draw))
    return 0


__all__ = ["Options", "run"]
