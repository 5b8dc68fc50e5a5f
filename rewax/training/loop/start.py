"""The initial training state of a run: a fresh one, or that of the newest checkpoint."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from rewax.agents.actor_critic import actor_of
from rewax.agents.base import Agent
from rewax.agents.config import steps_in
from rewax.envs.base import Env
from rewax.envs.leaves import EnvLeaves
from rewax.envs.registry import require_env
from rewax.physics.numerics.arguments import check_instance
from rewax.training.config import MOST_STEPS, TrainConfig
from rewax.training.loop.progress import say
from rewax.training.loop.warm_start import warm_started
from rewax.training.storage import checkpoint
from rewax.training.storage.description import changes, one_sided, plain, read_config, versions
from rewax.types import Key

_FLAGS = {"env": "--env", "scale": "--scale", "agent": "--algo"}


def check_arguments(agent: Any, env: Any, configs: Sequence[Any], describe: Any) -> None:
    """Raises ValueError for an argument of ``train`` that is of another type."""
    check_instance("agent", agent, Agent, "give an agent, make_sapo(env) for example")
    require_env(env)
    for config in configs:
        check_instance("config", config, TrainConfig, "give a TrainConfig(num_iterations=..., run_dir=...)")
    if describe is not None:
        check_instance("describe", describe, Mapping, "give entries of config.json by name, or None")


def first_state(
    agent: Agent,
    env: Env,
    config: TrainConfig,
    run_dir: Path,
    key: Key,
    description: Mapping[str, Any],
    console: Console,
) -> Any:
    """The initial training state.

    Args:
      agent: the algorithm.
      env: the environment that was given.
      config: of the run.
      run_dir: its directory.
      key: for ``agent.init``.
      description: what will be written into ``config.json``.
      console: for notes on differences from the run that is resumed.

    Raises:
      ValueError: the environment has other observations or actions than that of the agent; the directory
        holds a run and ``config.resume`` is off, or a run that this configuration cannot resume; or
        ``config.init_from`` does not fit, or is not that of the run that is resumed.
    """
    check_count(agent.config, env, config)
    _check_specs(agent, env)
    if not config.resume:
        metrics = run_dir / "metrics.csv"
        if checkpoint.latest_step(run_dir) is not None:
            raise ValueError(
                f"{run_dir} holds a run already: resume it (--resume, in Python resume=True) or choose another "
                "directory (--run-dir, run_dir)"
            )
        if metrics.is_file() and metrics.stat().st_size:
            raise ValueError(
                f"{run_dir} holds the metrics of a run, but no checkpoint: choose another directory (--run-dir, "
                "run_dir), or remove this one"
            )
        fresh = jax.jit(agent.init)(key)
        if not config.init_from:
            return fresh
        say(console, f"beginning with what {config.init_from} has learnt")
        return warm_started(fresh, config.init_from, agent.name)
    stored, wanted = read_config(run_dir), plain(description)
    began = first_run(stored)
    if config.init_from not in ("", began):
        how = f"with what {began} has learnt" if began else "with fresh networks"
        raise ValueError(f"{run_dir} holds a run that began {how}: resume it without --init-from (init_from)")
    if _identified(stored) != _identified(wanted):
        raise ValueError(
            f"{run_dir} holds a run with other identified parameters: give the environment of its start, on the "
            "command line the same --env-from, or --run-dir without --env-from"
        )
    if _sensors(stored) != _sensors(wanted):
        raise ValueError(
            f"{run_dir} holds a run with sensors {_sensors(stored)}, not {_sensors(wanted)}: resume it with its own, "
            "on the command line without --sensors"
        )
    differences = changes(stored, wanted) + one_sided(stored, wanted, "env_kwargs") + _other_versions(stored)
    for name, old, new in differences:
        if name in _FLAGS:
            raise ValueError(f"{run_dir} holds a run with {name} {old}, not {new}: resume it with {_FLAGS[name]} {old}")
    try:
        train_state = checkpoint.restore(
            run_dir,
            jax.eval_shape(agent.init, key),
            restart=agent,
            set_aside=True,
            notify=lambda text: say(console, text),
        )
    except checkpoint.OtherStructure as error:
        raise _other_options(run_dir, differences, error) from None
    for name, old, new in differences:
        if name in {f"{agent.name}.{option}" for option in getattr(agent.config, "start_only", ())}:
            say(console, f"note: {name} {new} has no effect on a run that began with {old}: it goes on from there")
        elif name == "train.seed" or not name.startswith("train."):  # options of reports may change
            say(console, f"note: resuming with {name} {new}, it was {old}")
    if others := _other_parameters(train_state, env):
        say(
            console,
            f"note: the environment given has other values of {', '.join(others)}: the run keeps its own, and only "
            "evaluations and pictures use those given",
        )
    say(console, f"resuming {run_dir} after iteration {int(train_state.iteration)}")
    return train_state


def check_count(agent_config: Any, env: Env, config: TrainConfig) -> None:
    """Raises ValueError if a run has more control steps than it can count."""
    if config.num_steps or not {"num_envs", "horizon"} <= set(dir(agent_config)):  # num_steps has a limit of its own
        return
    per_iteration = agent_config.num_envs * steps_in(agent_config, env)
    if config.num_iterations * per_iteration > MOST_STEPS:
        raise ValueError(
            f"num_iterations is {config.num_iterations} with {per_iteration} control steps each at most: give at most "
            f"{MOST_STEPS // per_iteration}, because a run counts up to {MOST_STEPS} steps"
        )


def _check_specs(agent: Agent, env: Env) -> None:
    """Raises ValueError if the policy of an agent reads other observations than an environment's, or acts otherwise."""
    actor = actor_of(agent.policy)
    if actor is None:
        return
    found = {name: tuple(spec.shape) for name, spec in env.observation_spec.items()}
    read = actor.shapes_read
    seen = {name: shape for name, shape in found.items() if name in read or not actor.config.observe}
    if seen != read:
        raise ValueError(
            f"env observes {_listed(found)}, but the agent was built for {_listed(read)}: give the environment of the "
            "agent"
        )
    if tuple(env.action_spec.shape) != (actor.action_size,):
        raise ValueError(
            f"env takes actions of shape {env.action_spec.shape}, but the agent was built for ({actor.action_size},): "
            "give the environment of the agent"
        )


def _listed(shapes: Mapping[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{name} {shape}" for name, shape in shapes.items())


def first_run(config: Mapping[str, Any]) -> str:
    """Directory of the run whose networks a run began with, as its ``config.json`` says; empty if there was none."""
    options = config.get("train")
    return str(options.get("init_from", "")) if isinstance(options, Mapping) else ""


def _other_versions(stored: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Other versions of JAX than those of the run, with which it does not go on bit by bit."""
    now, then = versions(), stored.get("versions", {})
    return [(name, then[name], now[name]) for name in ("jax", "jaxlib") if then.get(name, now[name]) != now[name]]


def _other_parameters(train_state: Any, env: Env) -> list[str]:
    """Names of up to three parameters of an environment that a training state has other values of."""
    stored = getattr(getattr(train_state, "environments", None), "env", None)
    if not isinstance(stored, EnvLeaves):
        return []
    found = []
    # The state's environment may be wrapped, in draws or a memory, and may be a batch.
    own = {name.replace(".env", ""): value for name, value in stored.arrays.items()}
    for name, value in EnvLeaves.of(env).arrays.items():
        before = own.get(name.replace(".env", ""))
        if before is None or jnp.shape(before) != jnp.shape(value) or not jnp.issubdtype(value.dtype, jnp.number):
            continue
        if not np.array_equal(np.asarray(before), np.asarray(value), equal_nan=True):
            found.append(name.removeprefix("."))
    return found[:3]


def _identified(config: Mapping[str, Any]) -> Any:
    """The parameters of ``rewax identify`` in a run's environment, or None."""
    kwargs = config.get("env_kwargs")
    return kwargs.get("identified") if isinstance(kwargs, Mapping) else None


def _sensors(config: Mapping[str, Any]) -> list[Any]:
    """Names of the sensors that ``rewax.make`` added to a run's environment, and their resolution if it was given."""
    kwargs = config.get("env_kwargs")
    kwargs = kwargs if isinstance(kwargs, Mapping) else {}
    return [*(kwargs.get("sensors") or ()), *(kwargs[name] for name in ("resolution",) if name in kwargs)]


def _other_options(run_dir: Path, differences: list[tuple[str, Any, Any]], error: ValueError) -> ValueError:
    """A sentence with the options that differ; where none does, with the array that does not fit."""
    options = [(name, old, new) for name, old, new in differences if not name.startswith("train.")]
    if not options:
        return error
    listed = ", ".join(f"{name} {old} (given: {new})" for name, old, new in options)
    return ValueError(
        f"{run_dir} holds a run with {listed}, whose training state does not fit the options given: resume it with the "
        "stored ones (config.json), or choose another directory (--run-dir)"
    )
