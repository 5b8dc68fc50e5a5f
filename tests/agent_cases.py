"""Every algorithm on a point mass, small enough to learn within seconds."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
import toys

from rewax.agents.agpo import AGPOConfig
from rewax.agents.ahac import AHACConfig
from rewax.agents.apg import APGConfig
from rewax.agents.base import Agent
from rewax.agents.demonstrated import DemonstratedConfig
from rewax.agents.flash_sac import FlashSACConfig
from rewax.agents.ivw import IVWConfig
from rewax.agents.ppo import PPOConfig
from rewax.agents.registry import make_agent
from rewax.agents.rpo import RPOConfig
from rewax.agents.sac import SACConfig
from rewax.agents.sapo import SAPOConfig
from rewax.agents.shac import SHACConfig
from rewax.agents.trajopt import TrajOptConfig

_POLICY = {
    "num_envs": 4,
    "horizon": 4,
    "num_iterations": 120,
    "actor_learning_rate": 1e-2,
    "actor_widths": (8,),
    "vector_features": 8,
    "stagger_episodes": True,
}
_CRITICS = {**_POLICY, "critic_learning_rate": 5e-3, "critic_widths": (8,)}
FIRST_ORDER = {**_CRITICS, "critic_passes": 2, "critic_minibatches": 2, "differentiate": "full"}
_REPLAY = {"batch_size": 64, "replay_size": 4000, "initial_temperature": 0.1, "target_rate": 0.05, "num_steps": 1}


class Case(NamedTuple):
    """An algorithm, its options, and the iterations that it needs."""

    name: str
    config: Any
    num_iterations: int = 120


CASES = {
    "sapo": Case("sapo", SAPOConfig(**FIRST_ORDER, initial_temperature=0.03)),
    "sapo_agpo": Case("sapo_agpo", AGPOConfig(**FIRST_ORDER, initial_temperature=0.03, max_ratio=2.0)),
    "sapo_ivw": Case("sapo_ivw", IVWConfig(**FIRST_ORDER, initial_temperature=0.03)),
    "shac": Case("shac", SHACConfig(**FIRST_ORDER)),
    "apg": Case("apg", APGConfig(**_POLICY, differentiate="full")),
    "apg_full": Case("apg", APGConfig(**{**_POLICY, "horizon": 0, "stagger_episodes": False})),
    "rpo": Case("rpo", RPOConfig(**FIRST_ORDER)),
    "ahac": Case("ahac", AHACConfig(**{**FIRST_ORDER, "horizon": 8}, min_horizon=2, initial_horizon=4)),
    "sapo_from_demonstrations": Case(
        "sapo_from_demonstrations",
        DemonstratedConfig(**FIRST_ORDER, initial_temperature=0.03, initial_log_std=-1.0, sequence_learning_rate=0.05),
    ),
    "ppo": Case("ppo", PPOConfig(**{**_CRITICS, "num_envs": 16, "horizon": 32}, minibatches=4), 40),
    "sac": Case("sac", SACConfig(**{**_CRITICS, "actor_learning_rate": 3e-3}, **_REPLAY), 300),
    "flash_sac": Case("flash_sac", FlashSACConfig(**{**_CRITICS, "actor_learning_rate": 3e-3}, **_REPLAY), 300),
    "trajopt": Case("trajopt", TrajOptConfig(num_envs=4, learning_rate=0.05)),
}
ENV = toys.point_mass()


@functools.cache
def agent(name: str) -> Agent:
    """The agent of a case; compiled once."""
    case = CASES[name]
    return make_agent(case.name, ENV, case.config)


@functools.cache
def trained(name: str, seed: int = 0) -> tuple[Any, list[dict[str, np.ndarray]]]:
    """The last state of a run and the metrics of every iteration."""
    state, rows = agent(name).init(jax.random.key(seed)), []
    for _ in range(CASES[name].num_iterations):
        state, metrics = agent(name).train_step(state)
        rows.append(metrics)
    return state, jax.device_get(rows)


def raw(leaf: Any) -> np.ndarray:
    """The array of a leaf; the key data of a key."""
    return np.asarray(jax.random.key_data(leaf) if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def assert_same_bits(a: Any, b: Any) -> None:
    """Two trees are equal to the bit."""
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(raw(x), raw(y)), a, b)
