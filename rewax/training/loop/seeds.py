"""Several seeds of one run, batched in one program."""

import contextlib
import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console

from rewax.agents.base import Agent
from rewax.envs.base import Env
from rewax.training.config import TrainConfig
from rewax.training.loop.compilation import compile_train_step
from rewax.training.loop.devices import SeedPlacement, seed_placement
from rewax.training.loop.interrupt import graceful_stop
from rewax.training.loop.progress import say
from rewax.training.loop.run import TrainResult
from rewax.training.loop.start import check_arguments
from rewax.training.loop.train import FINISHING, NOTHING_LOST, NOTHING_TRAINED, meanwhile, prepared, programs_of
from rewax.training.storage.run_directory import full_disk_is_one_sentence, hold


def train_seeds(
    agent: Agent,
    env: Env,
    configs: Sequence[TrainConfig],
    *,
    describe: Mapping[str, Any] | None = None,
    console: Console | None = None,
) -> list[TrainResult]:
    """Train one agent from several seeds at once: ``vmap(train_step)``, a run directory for each.

    Each seed's result equals that of a run by itself up to rounding, because a batched program adds in another order. A
    seed that fails ends; the others continue. Resumed seeds may have done different numbers of iterations. With several
    devices each computes some of the seeds, if their number divides that of the seeds.

    Args:
      agent, env, describe, console: as for ``train``.
      configs: equal except for ``seed`` and ``run_dir``. ``devices`` is the number of devices that the seeds are
        sharded over.

    Raises:
      ValueError: as for ``train``.
    """
    check_arguments(agent, env, configs, describe)
    console = console or Console()
    with contextlib.ExitStack() as stack:
        made = [
            stack.enter_context(hold(Path(config.run_dir).absolute(), must_exist=config.resume)) for config in configs
        ]
        stop = stack.enter_context(graceful_stop(functools.partial(say, console)))
        stack.enter_context(
            full_disk_is_one_sentence(
                Path(configs[0].run_dir).parent, lambda: "the newest checkpoint of each run is kept"
            )
        )
        stop.before_exit = lambda: [leave_nothing() for leave_nothing in made]
        stop.at_once = NOTHING_LOST if configs[0].resume else NOTHING_TRAINED
        where = seed_placement(len(configs), configs[0].devices)
        programs = programs_of(agent, env, configs[0])
        ready = [prepared(agent, env, config, describe, console, programs=programs) for config in configs]
        states = where.place(jax.tree.map(lambda *leaves: jnp.stack(leaves), *[state for state, _ in ready]))
        together = agent._replace(train_step=jax.vmap(agent.train_step), consumes=True)
        train_step: Any = None
        if any(
            not config.over(int(state.iteration), int(state.env_steps))
            for config, (state, _) in zip(configs, ready, strict=True)
        ):
            begin = functools.partial(meanwhile, programs, ready[0][0], configs[0])
            train_step = compile_train_step(together, states, console, where, begin)
        runs = [open_run() for _, open_run in ready]
        for run in runs:
            stack.callback(run.close)
        del ready
        try:
            for run in runs:
                run.save()  # a group of runs can be resumed only if each of them has a checkpoint
            for run in runs:
                run.begin(stop)
            while not (all(run.over for run in runs) or stop.requested):
                began = time.perf_counter()
                states, metrics = jax.block_until_ready(train_step(states))
                metrics, seconds = jax.device_get(metrics), time.perf_counter() - began
                for i, (run, state) in enumerate(zip(runs, _separate(where, states), strict=True)):
                    if not run.over:
                        run.take(state, {name: values[i] for name, values in metrics.items()}, seconds)
        finally:
            with contextlib.ExitStack() as ending:  # each is ended, even if another one cannot be written
                for run in runs:
                    ending.callback(run.end)
        stop.at_once, stop.notice = "", FINISHING
        return [run.finish(stop) for run in runs]


def _separate(where: SeedPlacement, states: Any) -> list[Any]:
    """The training state of each seed, on the first device, which evaluates it."""
    parts = [state for part in where.parts(states) for state in _unstacked(part)]
    return parts if where.mesh is None else jax.device_put(parts, where.mesh.devices.flat[0])


@jax.jit
def _unstacked(states: Any) -> list[Any]:
    """Compiled, because on a GPU a dispatch per leaf takes as long as an iteration."""
    return [jax.tree.map(lambda a, i=i: a[i], states) for i in range(len(jax.tree.leaves(states)[0]))]


__all__ = ["train_seeds"]
