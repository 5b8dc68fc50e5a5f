"""Runs loaded from their directories."""

import dataclasses
import functools
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from rewax.agents.base import Act, Agent
from rewax.agents.registry import algorithm, build_agent, list_algorithms
from rewax.envs import registry
from rewax.envs.base import Env
from rewax.envs.kit.checks import check_key
from rewax.envs.memory import MEMORY, Remembered, initial_memory
from rewax.physics.numerics.arguments import real_array
from rewax.physics.numerics.checks import described
from rewax.training.storage.description import read_config
from rewax.training.storage.modules import import_recorded
from rewax.types import Array, Key, Observation


class SavedRun(NamedTuple):
    """Contents of a run directory.

    Attributes:
      env: the environment that the run was trained in, unbatched.
      agent: the algorithm, bound to it; ``agent.policy(train_state, obs, key, deterministic=True)`` is the action for
        one environment.
      train_state: of the checkpoint.
      config: the contents of ``config.json``.
    """

    env: Env
    agent: Agent
    train_state: Any
    config: dict[str, Any]

    @property
    def looks(self) -> bool:
        """Whether the policy depends on observations; a learnt sequence of actions depends on the step only."""
        return "step" not in inspect.signature(self.agent.policy).parameters

    @property
    def initial_memory(self) -> Array | None:
        """The policy's memory at the beginning of an episode, shape (size,); None if it has none."""
        return initial_memory(self.agent.policy)

    def act(self, obs: Observation, key: Key | None = None, *, memory: Array | None = None) -> Array | Remembered:
        """The action for one environment: sampled with ``key``, deterministic without it; ``vmap`` for several.

        The first call compiles it; a call then takes about a millisecond.

        A policy with memory returns ``Remembered(action, memory)``. ``memory`` is what it returned at the step before,
        None at the first step of an episode:

            action, memory = run.act(state.obs, memory=memory)

        Raises:
          ValueError: the run learnt a sequence of actions; an observation is missing, or one, the key or the memory is
            not that of one environment; or a memory is given to a policy without one.
        """
        from rewax.agents.actor_critic import actor_of  # flax is slow to import, and loaded with an agent

        if not self.looks:
            raise ValueError(
                "this run learnt a sequence of actions: call agent.policy(train_state, obs, key, step=...) instead"
            )
        actor = actor_of(self.agent.policy)
        obs = _checked(obs, None if actor is None else actor.shapes_read)
        if key is not None:
            check_key(key)
        first, drawn = self.initial_memory, jax.random.key(0) if key is None else key
        if first is not None:
            if memory is not None and np.shape(memory) != first.shape:
                raise ValueError(
                    f"memory has shape {np.shape(memory)}: give shape {first.shape}, what act returned at the step "
                    "before, and None at the first step"
                )
            obs = {**obs, MEMORY: first if memory is None else memory}
        elif memory is not None:
            raise ValueError("memory is given, but this policy has none: leave it out")
        return _act(self.agent.policy, self.train_state, obs, drawn, deterministic=key is None)


def _checked(obs: Any, shapes: Mapping[str, tuple[int, ...]] | None) -> Any:
    """The arrays that a policy reads, of these shapes; all of them if the shapes are not known.

    Raises:
      ValueError: an array is missing or has another shape.
    """
    if not isinstance(obs, Mapping):
        names = "" if shapes is None else f", {', '.join(shapes)},"
        raise ValueError(f"the observation is {described(obs)}: give a dict of arrays by name{names} as state.obs")
    if shapes is None:
        return obs
    read = {}
    for name, shape in shapes.items():
        if name not in obs:
            given = ", ".join(map(str, obs)) or "nothing"
            raise ValueError(f"the observation has no array {name!r}, only {given}: give {', '.join(shapes)}")
        what = f"{name!r} of the observation"
        read[name] = real_array(what, obs[name], f"give an array of shape {shape}")
        if read[name].shape != shape:
            raise ValueError(f"{what} has shape {read[name].shape}: give shape {shape}, and jax.vmap for a batch")
    return read


@functools.partial(jax.jit, static_argnames=("policy", "deterministic"))
def _act(policy: Act, train_state: Any, obs: Observation, key: Key, *, deterministic: bool) -> Array | Remembered:
    return policy(train_state, obs, key, deterministic=deterministic)


def load_run(run_dir: str | Path, *, step: int | None = None, env: Env | None = None) -> SavedRun:
    """Build environment and agent of a run, and read its training state.

    Args:
      run_dir: directory of the run.
      step: iteration of the checkpoint; by default the newest that can be read.
      env: the environment that the run was trained in, unbatched; needed unless ``rewax.make`` built it. If the agent
        had ``randomize``, ``Randomized(env=env, randomize=randomize)``.

    Raises:
      ValueError: in one sentence: there is no such run or checkpoint, ``config.json`` has a wrong entry, or ``env`` is
        no environment.
    """
    from rewax.training.storage import checkpoint  # orbax is slow to import

    if checkpoint.latest_step(run_dir) is None:
        raise ValueError(f"{run_dir} holds no complete checkpoint: check the path")
    if env is not None:
        registry.require_env(env)
    config = read_config(run_dir)
    import_recorded(config if env is None else {**config, "env": None}, run_dir)
    name, file = config.get("agent"), Path(run_dir) / "config.json"
    if name is not None and name not in list_algorithms():
        raise ValueError(
            f"{run_dir} was trained with {name!r}, which is not registered here: import the module that registers it "
            "(--import my_module), or build the agent as for training and use checkpoint.restore(run_dir, "
            "jax.eval_shape(agent.init, jax.random.key(0)))"
        )
    if name is None or not isinstance(config.get(name), Mapping):
        raise ValueError(
            f"{file} names no algorithm and its options: build the agent as for training, "
            "and use checkpoint.restore(run_dir, jax.eval_shape(agent.init, jax.random.key(0)))"
        )
    stored = agent_config(algorithm(name).config_type, config[name], f"{file}: {name}")
    env = _recorded_env(config, file) if env is None else env
    agent = build_agent(name, env, stored)
    try:
        like = jax.eval_shape(agent.init, jax.random.key(0))
        train_state = checkpoint.restore(run_dir, like, step=step, restart=agent)
    except checkpoint.OtherStructure as error:
        raise checkpoint.OtherStructure(
            f"{error}; if the agent drew parameters (randomize=...), give the environment with them: "
            "load_run(run_dir, env=Randomized(env=env, randomize=...))"
        ) from None
    return SavedRun(env, agent, train_state, config)


def _recorded_env(config: Mapping[str, Any], file: Path) -> Env:
    """The environment that a ``config.json`` describes."""
    kwargs = config.get("env_kwargs", {})
    if not isinstance(config.get("env"), str) or "scale" not in config:
        raise ValueError(
            f"{file} names no environment, because rewax.make did not build it: build it as for "
            "training and give it, load_run(run_dir, env=env)"
        )
    if not isinstance(config["scale"], str):
        raise ValueError(f"{file}: scale is {config['scale']!r}: use one of {', '.join(map(repr, registry.SCALES))}")
    if not isinstance(kwargs, Mapping):
        raise ValueError(f"{file}: env_kwargs is {kwargs!r}: give the arguments of rewax.make by name, or {{}}")
    try:
        return registry.make(config["env"], scale=config["scale"], **kwargs)
    except Exception as error:  # wrong types of arguments reach the environment's own code
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise ValueError(
            f"{file}: env {config['env']!r} with scale {config['scale']!r} and env_kwargs {dict(kwargs)!r} cannot be "
            f"built: {kind}{' '.join(str(error).split())}"
        ) from error


def agent_config(config_type: type, stored: Mapping[str, Any], where: str = "the stored configuration") -> Any:
    """The agent's configuration from JSON; options that a newer version has added keep their defaults.

    Args:
      config_type: of the algorithm.
      stored: options by name.
      where: begins the sentence about an option that cannot be, with the file and the entry.

    Raises:
      ValueError: an unknown option, or a value that cannot be; one sentence.
    """
    known = [field.name for field in dataclasses.fields(config_type)]
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in stored.items()}
    for name in values:
        if name not in known:
            raise ValueError(
                f"{where}.{name} is unknown: {registry.did_you_mean(name, known)}this version has no such option: "
                "correct or remove it, or use the version that the run was made with"
            )
    try:
        return config_type(**values)
    except ValueError as error:
        raise ValueError(f"{where}.{error}") from None


__all__ = ["SavedRun", "load_run"]
