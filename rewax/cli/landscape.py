"""``rewax landscape``: draw the returns in the neighbourhood of a trained policy."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from rewax.agents.legal import Count, Natural, Positive, Seed
from rewax.cli.options import Imports, import_modules, one_of, parse
from rewax.cli.train import quiet
from rewax.whole_files import check_can_write, replacing


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      run: directory of the run.
      run_dir: the same, as an option.
      imports: module or .py file that registers environments or algorithms.
      size: number of points along either direction, odd.
      span: largest offset, in units of the norm of the parameters.
      episodes: number of episodes per point; all points have the same initial states.
      seed: draws directions and initial states.
      step: iteration of the checkpoint, the newest by default.
      out: picture to write; by default landscape.png in the run's directory. The numbers go to an .npz file beside it.
    """

    run: tyro.conf.Positional[str | None] = None
    run_dir: str | None = None
    imports: Imports = ()
    size: Count = 21
    span: Positive = 1.0
    episodes: Count = 8
    seed: Seed = 0
    step: Natural | None = None
    out: str | None = None


def run(argv: Sequence[str]) -> int:
    """Compute and draw the returns around a policy.

    Raises:
      ValueError: there is no such run, or an option is illegal; one sentence.
    """
    import jax
    import numpy as np

    from rewax.training.evaluation.landscape import landscape
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.storage.saved import load_run
    from rewax.viz.curves import landscape_picture

    quiet()
    options = parse(Options, argv, prog="rewax landscape", description="Draw the return around a trained policy.")
    needed = "rewax landscape needs one run directory: rewax landscape runs/RollingFlat-small-0"
    run_dir = one_of(options.run, options.run_dir, needed)
    out = Path(options.out or Path(run_dir) / "landscape.png")
    if options.out and (out.suffix != ".png" or not out.parent.is_dir()):
        raise ValueError(f"out is {out}: give a .png file in a folder that exists")
    enable_compilation_cache()
    import_modules(options.imports)
    saved = load_run(run_dir, step=options.step)
    check_can_write(out)
    found = landscape(
        saved.env,
        saved.agent.policy,
        saved.train_state,
        jax.random.key(options.seed),
        size=options.size,
        span=options.span,
        num_episodes=options.episodes,
    )
    with replacing(out.with_suffix(".npz")) as unfinished:
        np.savez(unfinished, **found._asdict())
    title = f"{saved.config['agent']} on {saved.config.get('env', '')}, iteration {int(saved.train_state.iteration)}"
    landscape_picture(found.offsets, found.returns, out, title=title)
    middle = found.returns[options.size // 2, options.size // 2]
    print(
        f"wrote {out}: return {middle:.4g} in the middle, {found.returns.min():.4g} to {found.returns.max():.4g} around"
    )
    return 0


__all__ = ["Options", "run"]
