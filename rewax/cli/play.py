"""``rewax play``: episodes of trained policies side by side on one page for a browser, offline or live."""

import dataclasses
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from rewax.agents.legal import AT_LEAST_2, Legal, Natural, Seed, is_whole
from rewax.cli.options import Imports, import_modules, names_of, parse
from rewax.cli.train import quiet

_PORT = Legal("give an integer from 0 (any free port) to 65535", lambda v: is_whole(v) and 0 <= v <= 65535)
_POLL = 1.0
"""Interval at which a live run is checked for a new checkpoint [s]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      runs: directories of runs, or names of tasks with a packaged policy; one to eight.
      scale: of the tasks given by name; by default what suits the device.
      out: page to write, a file with the ending .html.
      imports: module or .py file that registers environments or algorithms.
      seed: draws the initial state; runs of one environment have the same.
      sampled: sample the actions as in training; by default they are deterministic.
      step: iteration of the checkpoints, the newest by default.
      frames: largest number of recorded frames of an episode.
      live: instead of writing a page, serve one that shows each new checkpoint of one run, while it trains.
      host: address of the live page; 127.0.0.1 is reachable from this machine only.
      port: of the live page.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    scale: str | None = None
    out: str = "player.html"
    imports: Imports = ()
    seed: Seed = 0
    sampled: tyro.conf.FlagCreatePairsOff[bool] = False
    step: Natural | None = None
    frames: Annotated[int, AT_LEAST_2] = 301
    live: tyro.conf.FlagCreatePairsOff[bool] = False
    host: str = "127.0.0.1"
    port: Annotated[int, _PORT] = 8080


def run(argv: Sequence[str]) -> int:
    """Record an episode of each run and write the page, or serve a live one.

    Returns:
      Exit code: 0; 128 + signal after a live view that was interrupted.

    Raises:
      ValueError: no runs or too many, a run that cannot be read, an environment without anything to draw; one sentence.
    """
    import jax

    from rewax.fixed_sources import build_ahead
    from rewax.training.evaluation.cameras import as_recorded
    from rewax.training.evaluation.recording import record
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.storage.policies import open_run
    from rewax.viz.player import MAX_RUNS, write_player

    quiet()
    options = parse(Options, argv, prog="rewax play", description="Show trained policies in a browser.")
    if not 1 <= len(options.runs) <= MAX_RUNS:
        raise ValueError(f"rewax play needs 1 to {MAX_RUNS} run directories or tasks: rewax play HandFlip")
    if not options.live and (options.host, options.port) != (Options.host, Options.port):
        raise ValueError("--host and --port are of a live page: give --live too, or leave them out")
    out = Path(options.out)
    if out.suffix not in (".html", ".htm") or not out.parent.is_dir():
        raise ValueError(f"out is {out}: give an .html file in a folder that exists")
    enable_compilation_cache()
    import_modules(options.imports)
    build_ahead()
    if options.live:
        return _live(options)
    opened = [open_run(directory, step=options.step, scale=options.scale) for directory in options.runs]
    recordings = []
    for directory, name, saved in zip(options.runs, names_of(options.runs), opened, strict=True):
        recordings.append(
            record(
                as_recorded(saved.env),
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
    write_player(recordings, out, title=", ".join(names_of(options.runs)))
    print(f"wrote {out}, {out.stat().st_size / 1e6:.1f} MB: open it in a browser")
    return 0


def _live(options: Options) -> int:
    """Show the newest checkpoint of a run and each later one, until interrupted."""
    import jax

    from rewax.training.evaluation.cameras import as_recorded
    from rewax.training.evaluation.recording import make_record
    from rewax.training.storage import checkpoint
    from rewax.training.storage.policies import is_policy
    from rewax.training.storage.saved import load_run
    from rewax.viz.live import LiveViewer

    if len(options.runs) != 1 or options.step is not None:
        raise ValueError("a live view shows the newest checkpoint of one run: give one run directory, and no step")
    directory = options.runs[0]
    if options.scale is not None:
        raise ValueError("a live view shows a run at the scale it trains at: leave out --scale")
    if is_policy(directory):
        raise ValueError(f"a live view shows a run that trains: rewax play {directory} shows its policy")
    newest = checkpoint.latest_step(directory)  # read first: the run may write another one from here on
    saved, (name,) = load_run(directory), names_of(options.runs)
    env = as_recorded(saved.env)
    record = make_record(env, saved.agent.policy, max_frames=options.frames, deterministic=not options.sampled)
    viewer = LiveViewer(host=options.host, port=options.port)
    print(f"{viewer.url} shows {directory}; Ctrl-C ends it", flush=True)
    train_state = saved.train_state
    try:
        while True:
            iteration = int(train_state.iteration)
            recording = record(train_state, jax.random.key(options.seed), name)
            caption = f"iteration {iteration}: {int(recording.steps[-1])} steps, return {recording.totals[-1]:.4g}"
            print(caption, flush=True)
            viewer.show(recording, f"**{name}**, {caption}")
            while checkpoint.latest_step(directory) in (None, newest):
                time.sleep(_POLL)
            newest = checkpoint.latest_step(directory)  # a damaged one is skipped and not tried again
            try:
                train_state = checkpoint.restore(directory, train_state)
            except checkpoint.Unread as error:  # the machine has too little room now
                print(f"warning: {error}", flush=True)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    finally:
        viewer.close()


__all__ = ["Options", "run"]
