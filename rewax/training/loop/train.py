"""The training function: start or resume a run, iterate, finish."""

import contextlib
import dataclasses
import functools
import importlib
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from rewax.agents.base import Agent
from rewax.envs.base import Env
from rewax.lowering.report import recorded
from rewax.training.config import ReportConfig, TrainConfig
from rewax.training.evaluation.programs import Programs
from rewax.training.loop.compilation import compile_train_step, compiler_options, kept
from rewax.training.loop.devices import ONE_DEVICE, Placement, on_one_device, placement
from rewax.training.loop.hosts import Leader, follow, leads, received
from rewax.training.loop.interrupt import graceful_stop
from rewax.training.loop.progress import say
from rewax.training.loop.run import RESUMED, Run, TrainResult
from rewax.training.loop.start import check_arguments, first_run, first_state
from rewax.training.storage import checkpoint
from rewax.training.storage.description import (
    append_lowering,
    describe_run,
    provenance_of_parts,
    read_config,
    write_config,
    write_environment,
)
from rewax.training.storage.metrics import need_wandb
from rewax.training.storage.run_directory import CannotWrite, full_disk_is_one_sentence, hold
from rewax.training.storage.schedule import continued
from rewax.types import Key

_EVALUATION_STREAM = 0x5EED  # folded into the seed: evaluation and training draw different random numbers
_NOTHING_KEPT = "stopped while compiling: nothing was trained, and nothing is kept"
NOTHING_TRAINED = "stopped before the first iteration: nothing was trained"
NOTHING_LOST = f"stopped before the first iteration: the same command continues from the checkpoint {RESUMED}"
_ANEW = ("env", "scale", "env_kwargs", "agent", "versions")
"""Entries of ``config.json`` that a resumed run does not take over."""
FINISHING = "everything trained is kept; finishing evaluation and pictures, once more to leave at once"


def train(
    agent: Agent,
    env: Env,
    config: TrainConfig,
    *,
    describe: Mapping[str, Any] | None = None,
    console: Console | None = None,
) -> TrainResult:
    """Train an agent and leave a run directory: checkpoints, metrics, evaluations, plots.

    On a CPU a run resumed from a checkpoint gives the same bits as one that never stopped: the same final state and the
    same ``metrics.csv``. The last checkpoint is written before the final evaluation and the pictures, so that a failure
    there does not lose it.

    A run stops early when more than ``config.max_failed_share`` of its episodes fail numerically, or when its critics'
    loss is not finite as often. It stops at once when a learnt parameter is not finite. No checkpoint holds such a
    parameter, and the newest checkpoint from before the failures is kept.

    Ctrl-C, SIGTERM and SIGHUP end the run after its present iteration: it saves a checkpoint and draws its pictures. A
    second signal ends the process at once. The first one raises nothing here: ``train`` returns, with the signal in
    ``TrainResult.signum``. A loop over runs should test it, or it goes on to the next run.

    With several processes (``jax.distributed.initialize``) each of them calls this function: the first one does
    everything described here, and the others compute their shard of the environments.

    Args:
      agent: algorithm bound to ``env``.
      env: unbatched environment to evaluate in.
      config: length, seed, directory and reports of the run.
      describe: further entries of ``config.json``, beside ``config`` and the descriptions of agent and env; ``env``,
        ``scale`` and ``agent`` must be the same on resuming.
      console: to print to; standard output by default.

    Returns:
      ``train_state``, the last one; ``evaluation``, a dict of the final evaluation's row (``deterministic_mean``,
      ``sampled_mean``, ...), empty after an early stop; ``signum``; and ``failure``, a sentence if the run failed.

    Raises:
      ValueError: an argument is of another type, ``env`` has other observations or actions than the environment of
        ``agent``, ``run_dir`` cannot be used, another process uses it, it holds a run already and ``resume`` is off,
        its run cannot be resumed, or ``wandb`` is asked for and not installed.
    """
    check_arguments(agent, env, [config], describe)
    console = console or Console()
    if not leads():
        return _follow(agent, config)
    leader = Leader()
    with (
        _ended(leader),
        hold(Path(config.run_dir).absolute(), must_exist=config.resume) as leave_nothing,
        graceful_stop(functools.partial(say, console)) as stop,
        full_disk_is_one_sentence(Path(config.run_dir), functools.partial(_kept, config.run_dir)),
    ):
        stop.before_exit = leave_nothing
        stop.at_once = NOTHING_LOST if config.resume else _NOTHING_KEPT
        where = placement(getattr(agent.config, "num_envs", None), config.devices)
        programs = programs_of(agent, env, config)
        train_state, open_run = prepared(agent, env, config, describe, console, where, leader, programs)
        train_step, decisions = None, []
        if not config.over(int(train_state.iteration), int(train_state.env_steps)):
            with recorded() as decisions:
                begin = functools.partial(meanwhile, programs, train_state, config)
                train_step = compile_train_step(agent, train_state, console, where, begin)
        if agent.consumes:
            programs.wait()  # the first iteration consumes the state that they are compiled with
        stop.at_once = NOTHING_LOST if config.resume else NOTHING_TRAINED
        run = open_run()
        append_lowering(config.run_dir, decisions)
        try:
            if train_step is not None:
                run.iterate(train_step, stop)
            stop.at_once, stop.notice = "", FINISHING
            return run.finish(stop)
        finally:
            run.close()


def programs_of(agent: Agent, env: Env, config: TrainConfig) -> Programs:
    """The run's programs for evaluation and recording, or those of the run before; see ``programs_kept``."""
    options = compiler_options(agent)
    policy = (agent.name, agent.config) if agent.name else agent.policy  # bound methods of equal actors differ
    key = (id(env), policy, config.num_eval_episodes, config.plots, options)
    return kept("programs", key, lambda: Programs(env, agent.policy, config, options))[0]


def meanwhile(programs: Programs, train_state: Any, config: TrainConfig) -> None:
    """Start threads that work while XLA compiles the train step: other programs, and a slow import."""
    programs.compile_in_background(on_one_device(train_state), _evaluation_key(config))
    if config.tensorboard:
        threading.Thread(target=importlib.import_module, args=("tensorboardX",), daemon=True).start()


def _kept(run_dir: str) -> str:
    """A clause about the newest checkpoint of a run whose disk is full."""
    newest = checkpoint.latest_step(run_dir)
    if newest is None:
        return "nothing was trained"
    return f"the checkpoint of iteration {newest} is kept, and the same command continues from it {RESUMED}"


@contextlib.contextmanager
def _ended(leader: Leader) -> Iterator[None]:
    """Ends the other processes at the end, and after an input that is refused."""
    try:
        yield
    except (ValueError, CannotWrite):
        leader.end()
        raise
    leader.end()


def _follow(agent: Agent, config: TrainConfig) -> TrainResult:
    """Train in a process that does not lead. The leader handles a signal to stop; a second one ends this process."""
    with graceful_stop(lambda _: None):
        train_state = received(jax.jit(agent.init)(jax.random.key(config.seed)))
        if train_state is None:
            return TrainResult(None, {}, failure="the first process did not begin")
        where = placement(getattr(agent.config, "num_envs", None), config.devices)
        train_state, train_step = where.place(train_state), None
        if not config.over(int(train_state.iteration), int(train_state.env_steps)):
            train_step = compile_train_step(agent, train_state, Console(quiet=True), where)
        return TrainResult(follow(train_step, train_state), {})


def prepared(
    agent: Agent,
    env: Env,
    config: TrainConfig,
    describe: Mapping[str, Any] | None,
    console: Console,
    where: Placement = ONE_DEVICE,
    leader: Leader | None = None,
    programs: Programs | None = None,
) -> tuple[Any, Callable[[], Run]]:
    """The initial training state, and a function that opens the run's files; nothing is written before it is called.

    The caller holds the run's directory.
    """
    if config.wandb:
        need_wandb()
    run_dir, seed_key = Path(config.run_dir).absolute(), jax.random.key(config.seed)
    description = {**describe_run(agent, env, describe), "train": config}
    leader = leader or Leader()
    train_state = where.place(leader.hand_out(first_state(agent, env, config, run_dir, seed_key, description, console)))

    def open_run() -> Run:
        stored = read_config(run_dir) if config.resume else {}
        schedule = continued(stored, int(train_state.iteration), config)
        kept = {name: value for name, value in stored.items() if name not in _ANEW}
        if config.resume:  # what the run began with stays
            description["train"] = dataclasses.replace(config, init_from=first_run(stored))
        made = {"schedule": schedule, "provenance": provenance_of_parts(stored, int(train_state.iteration))}
        write_config(run_dir, {**kept, **description, **made})
        write_environment(run_dir)
        key = _evaluation_key(config)
        known = programs or programs_of(agent, env, config)
        run = Run(agent, env, known, config, run_dir, key, train_state, console, leader)
        run.report_lost_rows(schedule)
        return run

    return train_state, open_run


def _evaluation_key(config: TrainConfig) -> Key:
    return jax.random.fold_in(jax.random.key(config.seed), _EVALUATION_STREAM)


__all__ = ["ReportConfig", "TrainConfig", "TrainResult", "meanwhile", "prepared", "programs_of", "train"]
