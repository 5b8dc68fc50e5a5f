"""A point mass on a line and a learner of one number: small enough to know every result by hand."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.base import Agent
from rewax.envs.base import ArraySpec, State, first_state, next_state
from rewax.envs.wrappers import AutoReset
from rewax.status import Status
from rewax.types import Array, Key


@struct.dataclass
class PointMass:
    """A point at x, uniform in [0.5, 1.5] at first; an action moves it by ``gain * clip(action)``; reward -x^2."""

    gain: Array
    length: int = struct.static_field(default=5)

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        return {"x": ArraySpec((1,))}

    @property
    def action_spec(self) -> ArraySpec:
        return ArraySpec((1,), -1.0, 1.0)

    @property
    def episode_length(self) -> int:
        return self.length

    def reset(self, key: Key) -> State:
        key, draw = jax.random.split(key)
        x = jax.random.uniform(draw, (1,), minval=0.5, maxval=1.5)
        return first_state(physics=x, obs={"x": x}, metrics={"distance": jnp.abs(x[0])}, key=key)

    def step(self, state: State, action: Array) -> State:
        x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
        return self.after(state, x)

    def after(self, state: State, x: Array, **kwargs: Any) -> State:
        """The state after a step to x."""
        return next_state(
            state,
            physics=x,
            obs={"x": x},
            reward=-(x[0] ** 2),
            metrics={"distance": jnp.abs(x[0])},
            episode_length=self.length,
            **kwargs,
        )

    def particles(self, physics: Array) -> Array:
        """A cloud of eight points about x."""
        corners = jnp.stack(jnp.meshgrid(*[jnp.array([0.0, 0.1])] * 3), axis=-1).reshape(8, 3)
        return corners + jnp.array([1.0, 0.0, 0.0]) * physics


def point_mass(length: int = 5) -> PointMass:
    """A point mass with gain 0.5."""
    return PointMass(gain=jnp.float32(0.5), length=length)


@struct.dataclass
class ToyState:
    """Everything of a toy run. ``bias``: the policy's parameter; ``memory``: a leaf without elements."""

    iteration: Array
    env_steps: Array
    bias: Array
    envs: State
    key: Key
    memory: Array


_made: dict[tuple[Any, ...], tuple[Any, Agent]] = {}
"""Toys, each with the environment that it was made for: while that is kept, no other has its id."""


def make_toy(env: Any, *, num_envs: int = 4, horizon: int = 3, width: int = 1, noise: float = 0.1) -> Agent:
    """Gradient ascent on the mean reward of short rollouts of ``action = bias + noise``, through the environment.

    The same arguments give the same object, so that tests share what they compile; point masses are the same if their
    numbers are.
    """
    which = (float(env.gain), env.length) if type(env) is PointMass else (id(env),)
    key = (*which, num_envs, horizon, width, noise)
    if key not in _made:
        _made[key] = env, _new_toy(env, num_envs, horizon, width, noise)
    return _made[key][1]


def _new_toy(env: Any, num_envs: int, horizon: int, width: int, noise: float) -> Agent:
    wrapped = AutoReset(env=env)

    def init(key: Key) -> ToyState:
        key, reset_key = jax.random.split(key)
        return ToyState(
            iteration=jnp.int32(0),
            env_steps=jnp.int32(0),
            bias=jnp.zeros(width),
            envs=jax.vmap(wrapped.reset)(jax.random.split(reset_key, num_envs)),
            key=key,
            memory=jnp.zeros((0, 2)),
        )

    def rollout(bias: Array, envs: State, key: Key) -> tuple[Array, tuple[State, Array]]:
        def step(envs: State, key: Key) -> tuple[State, tuple[Array, ...]]:
            actions = bias[:1] + noise * jax.random.normal(key, (num_envs, 1))
            envs = jax.vmap(wrapped.step)(envs, actions)
            return envs, (envs.reward, envs.done, envs.status, envs.failed_leaf)

        envs, (rewards, *ends) = jax.lax.scan(step, envs, jax.random.split(key, horizon))
        return jnp.mean(rewards), (envs, ends)

    @jax.jit
    def train_step(ts: ToyState) -> tuple[ToyState, dict[str, Array]]:
        key, draw = jax.random.split(ts.key)
        (reward, (envs, ends)), slope = jax.value_and_grad(rollout, has_aux=True)(ts.bias, ts.envs, draw)
        new = ts.replace(
            iteration=ts.iteration + 1,
            env_steps=ts.env_steps + num_envs * horizon,
            bias=ts.bias + 0.1 * slope,
            envs=jax.lax.stop_gradient(envs),
            key=key,
        )
        metrics = {
            "return": jnp.where(jnp.any(ends[0]), reward * env.episode_length, jnp.nan),
            "reward": reward,
            "entropy": jnp.float32(noise),
            "alpha": 1.0 / (1.0 + ts.iteration),
            **failures(*ends),
        }
        return new, metrics

    def failures(dones: Array, status: Array, failed_leaf: Array) -> dict[str, Array]:
        """As every agent reports them; shapes (horizon, num_envs)."""
        failed = (status & int(Status.NAN)) != 0
        return {
            "episodes": jnp.sum(dones),
            "failed_episodes": jnp.sum(failed),
            **{f"status/{bit.name}": jnp.sum((status & int(bit)) != 0) for bit in Status if bit},
            "failed_env": jnp.where(jnp.any(failed), jnp.argmax(jnp.any(failed, axis=0)), -1),
            "failed_leaf": jnp.max(failed_leaf),
        }

    def policy(ts: ToyState, obs: dict[str, Array], key: Key, deterministic: bool = False) -> Array:
        del obs
        return ts.bias[:1] if deterministic else ts.bias[:1] + noise * jax.random.normal(key, (1,))

    return Agent(init, train_step, policy)


def subprocess_environment() -> dict[str, str]:
    """Environment variables with which another Python process imports these toys and this checkout."""
    tests = Path(__file__).parent
    paths = os.pathsep.join([str(tests), str(tests.parent)])
    # 3: XLA prints an "error" for each program that it loads from its own cache.
    return {**os.environ, "PYTHONPATH": paths, "COLUMNS": "200", "TF_CPP_MIN_LOG_LEVEL": "3"}


TINY = [
    "--sapo.num-envs=2", "--sapo.horizon=2", "--sapo.num-iterations=1", "--sapo.critic-passes=1", "--sapo.critic-minibatches=1",
    "--sapo.actor-widths", "4", "4", "--sapo.critic-widths", "4", "--sapo.vector-features=4",
    "--train.no-baselines", "--train.no-tensorboard", "--train.num-eval-episodes=2",
]  # fmt: skip
"""Options of the smallest run of ``rewax train``."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ToyConfig:
    """The toy's hyper-parameters."""

    num_envs: int = 4
    horizon: int = 3
    num_iterations: int = 2


def make_configured(env: Any, config: ToyConfig) -> Agent:
    """``make_toy`` with a configuration."""
    return make_toy(env, num_envs=config.num_envs, horizon=config.horizon)


QUICK_RUN = ["--train.no-plots", "--train.no-baselines", "--train.num-eval-episodes=2", "--train.no-tensorboard"]
"""Options of ``rewax train`` without pictures."""
