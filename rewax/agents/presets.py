"""Tuned configurations, by environment and scale."""

import dataclasses
from typing import Any

from rewax.agents.sapo import SAPOConfig

SMALL = SAPOConfig(
    num_envs=8,
    horizon=16,
    num_iterations=120,
    critic_passes=8,
    critic_minibatches=2,
    actor_widths=(128, 64),
    critic_widths=(128, 64),
    point_widths=(32, 64),
    point_features=32,
    vector_features=64,
    initial_temperature=0.002,
    temperature_learning_rate=0.02,
    stagger_episodes=True,
    differentiate="full",
)
"""For two cores: small networks, short rollouts, a temperature that does not drown differences of 0.01 in a reward."""

_RUNNER = SAPOConfig(num_envs=64, num_iterations=5000, actor_widths=(128, 64, 32), critic_widths=(64, 64))
"""The paper's for AntRun and the dflex suite: 64 environments, 10 million steps."""
_HUMANOID = dataclasses.replace(_RUNNER, actor_widths=(256, 128), critic_widths=(128, 128))
_CARTPOLE = dataclasses.replace(_RUNNER, actor_widths=(64, 64), critic_widths=(64, 64))


def _small(paper: SAPOConfig, **changes: Any) -> SAPOConfig:
    """The same networks on two cores: fewer environments and iterations; a rollout's memory is no concern."""
    small = {"num_envs": 32, "num_iterations": 300, "vector_features": 64, "initial_temperature": 0.1}
    shared = {"stagger_episodes": True, "differentiate": "full"}
    return dataclasses.replace(paper, **{**small, **shared, **changes})


_SAPO: dict[tuple[str, str], SAPOConfig] = {
    ("RollingFlat", "paper"): SAPOConfig(num_iterations=4000),
    ("RollingFlat", "small"): SMALL,
    ("AntRun", "paper"): dataclasses.replace(_RUNNER, num_iterations=2000),
    ("AntRun", "small"): _small(_RUNNER),
    ("Ant", "paper"): _RUNNER,
    ("Ant", "small"): _small(_RUNNER),
    ("CartpoleSwingUp", "paper"): _CARTPOLE,
    ("CartpoleSwingUp", "small"): _small(_CARTPOLE, num_iterations=600),
    ("HalfCheetah", "paper"): _RUNNER,
    ("HalfCheetah", "small"): _small(_RUNNER),
    ("HandReorient", "paper"): SAPOConfig(num_envs=64, num_iterations=2000),
    ("HandReorient", "small"): _small(_HUMANOID),
    ("Hopper", "paper"): _RUNNER,
    ("Hopper", "small"): _small(_RUNNER, num_iterations=400),
    ("Humanoid", "paper"): _HUMANOID,
    ("Humanoid", "small"): _small(_HUMANOID),
    ("Quadruped", "paper"): _HUMANOID,
    ("Quadruped", "small"): _small(_HUMANOID),
}


def sapo_preset(env_name: str, scale: str) -> SAPOConfig:
    """Hyper-parameters of SAPO for a registered environment; for one without tuned values those of its scale.

    Raises:
      ValueError: there is no such scale.
    """
    if scale not in ("paper", "small"):
        raise ValueError(f"there is no scale {scale!r}: use paper or small")
    return _SAPO.get((env_name, scale), SMALL if scale == "small" else SAPOConfig())
