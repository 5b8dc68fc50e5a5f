"""``rewax play``: what runs have learnt, side by side in one page that a browser opens without a network, or live."""

import dataclasses
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import tyro

from rewax.cli.options import Imports, import_modules, parse
from rewax.cli.train import quiet

_POLL = 1.0
"""Between looks for a new checkpoint of a live run [s]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      runs: directories of runs, or names of tasks whose trained policy the package brings; one to eight.
      scale: of the tasks given by name; by default what suits the device.
      out: page to write, an .html file.
      imports: module or .py file that registers environments or algorithms.
      seed: draws the start of the episode; the same one for runs of one environment.
      sampled: draw the actions as in training, instead of taking the most likely ones.
      step: iteration of the checkpoints, the newest by default.
      frames: moments that are kept of an episode, at most.
      live: instead of writing a page, serve one that shows each new checkpoint of one run, while it trains.
      host: where the live page is served; 127.0.0.1 is seen by this machine alone.
      port: of the live page.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    scale: str | None = None
    out: str = "player.html"
    imports: Imports = ()
    seed: int = 0
    sampled: tyro.conf.FlagCreatePairsOff[bool] = False
    step: int | None = None
    frames: int = 301
    live: tyro.conf.FlagCreatePairsOff[bool] = False
    host: str = "127.0.0.1"
    port: int = 8080


def run(argv: Sequence[str]) -> int:
    """Record an episode of each run and write the page, or serve a live one.

    Returns:
      Exit code: 0; 128 + signal after a live view that was interrupted.

    Raises:
      ValueError: no runs or too many, a run that cannot be read, an environment that shows nothing; one sentence.
    """
    import jax

    from rewax.fixed_sources import build_ahead
    from rewax.training.evaluation.recording import record
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.storage.policies import open_run
    from rewax.viz.player import MAX_RUNS, write_player

    quiet()
    options = parse(Options, argv, prog="rewax play", description="Show what runs have learnt in a browser.")
    if not 1 <= len(options.runs) <= MAX_RUNS:
        raise ValueError(f"rewax play needs 1 to {MAX_RUNS} run directories or tasks: rewax play HandFlip")
    out = Path(options.out)
    if out.suffix not in (".html", ".htm") or not out.parent.is_dir():
        raise ValueError(f"out is {out}: give an .html file in a folder that exists")
    if options.frames < 2:
        raise ValueError(f"frames is {options.frames}: use 2 or more")
    enable_compilation_cache()
    import_modules(options.imports)
    build_ahead()
    if options.live:
        return _live(options)
    recordings = []
    for directory, name in zip(options.runs, _names(options.runs), strict=True):
        saved = open_run(directory, step=options.step, scale=options.scale)
        recordings.append(
            record(
                getattr(saved.env, "unwrapped", saved.env),
                saved.agent.policy,
                saved.train_state,
                jax.random.key(options.seed),
                max_frames=options.frames,
                deterministic=not options.sampled,
                name=f"{name}, iteration {int(saved.train_state.iteration)}",
            )
        )
        last = recordings[-1]
        print(f"{directory}: {int(last.steps[-1])} steps, return {last.totals[-1]:.4g}")
    write_player(recordings, out, title=", ".join(_names(options.runs)))
    print(f"wrote {out}, {out.stat().st_size / 1e6:.1f} MB: open it in a browser")
    return 0


def _live(options: Options) -> int:
    """Show the newest checkpoint of a run, and each that follows, until interrupted."""
    import jax

    from rewax.training.evaluation.recording import make_record
    from rewax.training.storage import checkpoint
    from rewax.training.storage.policies import is_policy
    from rewax.training.storage.saved import load_run
    from rewax.viz.live import LiveViewer

    if len(options.runs) != 1 or options.step is not None:
        raise ValueError("a live view shows the newest checkpoint of one run: give one run directory, and no step")
    directory = options.runs[0]
    if is_policy(directory):
        raise ValueError(f"a live view shows a run that trains: rewax play {directory} shows its policy")
    saved, (name,) = load_run(directory), _names(options.runs)
    env = getattr(saved.env, "unwrapped", saved.env)
    record = make_record(env, saved.agent.policy, max_frames=options.frames, deterministic=not options.sampled)
    viewer = LiveViewer(host=options.host, port=options.port)
    print(f"{viewer.url} shows {directory}; Ctrl-C ends it", flush=True)
    train_state, newest = saved.train_state, checkpoint.latest_step(directory)
    try:
        while True:
            iteration = int(train_state.iteration)
            recording = record(train_state, jax.random.key(options.seed), name)
            summary = f"iteration {iteration}: {int(recording.steps[-1])} steps, return {recording.totals[-1]:.4g}"
            print(summary, flush=True)
            viewer.show(recording, f"**{name}**, {summary}")
            while checkpoint.latest_step(directory) in (None, newest):
                time.sleep(_POLL)
            newest = checkpoint.latest_step(directory)  # one that is damaged is passed over, and not tried again
            train_state = checkpoint.restore(directory, train_state)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    finally:
        viewer.close()


def _names(directories: Sequence[str]) -> list[str]:
    """The last part of each path, or the whole of those whose last parts are the same."""
    last = [Path(directory).resolve().name for directory in directories]
    return [
        name if last.count(name) == 1 else str(directory) for name, directory in zip(last, directories, strict=True)
    ]


__all__ = ["Options", "run"]
