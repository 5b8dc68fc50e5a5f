"""A point that must reach a goal, which it is shown at the first step only; and small agents with a memory."""

from typing import Any

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.registry import algorithm
from rewax.envs.base import ArraySpec, State, first_state, next_state
from rewax.types import Array, Key

SIZE = 3
TINY = {
    "num_envs": 4, "horizon": 5, "num_iterations": 10, "actor_widths": (4,), "vector_features": 4, "memory": SIZE,
    "stagger_episodes": True,
}  # fmt: skip
CRITICS = {**TINY, "critic_widths": (4,)}
FIRST_ORDER = {**CRITICS, "critic_passes": 1, "critic_minibatches": 1, "differentiate": "full"}
OPTIONS: dict[str, dict[str, Any]] = {
    "sapo": FIRST_ORDER,
    "shac": FIRST_ORDER,
    "rpo": {**FIRST_ORDER, "epochs": 2},
    "ahac": {**FIRST_ORDER, "min_horizon": 2, "initial_horizon": 4},
    "apg": {**TINY, "differentiate": "full"},
    "ppo": {**CRITICS, "epochs": 2, "minibatches": 2},
}
"""The algorithms that train a memory, and small options."""


@struct.dataclass
class ShownOnce:
    """A point moves along a line; ``goal`` is 0 except at the first step; the reward is minus the squared distance."""

    gain: Array
    length: int = struct.static_field(default=4)

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        return {"goal": ArraySpec((1,)), "x": ArraySpec((1,))}

    @property
    def action_spec(self) -> ArraySpec:
        return ArraySpec((1,), -1.0, 1.0)

    @property
    def episode_length(self) -> int:
        return self.length

    def reset(self, key: Key) -> State:
        key, draw = jax.random.split(key)
        goal = jax.random.uniform(draw, (1,), minval=-1.0, maxval=1.0)
        x = jnp.zeros_like(goal)
        return first_state(physics={"x": x, "goal": goal}, obs={"goal": goal, "x": x}, metrics={}, key=key)

    def step(self, state: State, action: Array) -> State:
        goal = state.physics["goal"]
        x = state.physics["x"] + self.gain * jnp.clip(action, -1.0, 1.0)
        return next_state(
            state,
            physics={"x": x, "goal": goal},
            obs={"goal": jnp.zeros_like(goal), "x": x},
            reward=-jnp.sum((x - goal) ** 2),
            metrics={},
            episode_length=self.length,
        )


def shown_once(length: int = 4) -> ShownOnce:
    return ShownOnce(gain=jnp.float32(0.5), length=length)


def config(name: str, **changes: Any) -> Any:
    return algorithm(name).config_type(**{**OPTIONS[name], **changes})


def agent(name: str, env: Any = None, **changes: Any) -> Any:
    return algorithm(name).make(shown_once() if env is None else env, config(name, **changes))
