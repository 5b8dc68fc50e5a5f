"""Tuned configurations, by environment and scale."""

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

_SAPO: dict[tuple[str, str], SAPOConfig] = {
    ("RollingFlat", "paper"): SAPOConfig(num_iterations=4000),
    ("RollingFlat", "small"): SMALL,
}


def sapo_preset(env_name: str, scale: str) -> SAPOConfig:
    """Hyper-parameters of SAPO for a registered environment; for one without tuned values those of its scale."""
    return _SAPO.get((env_name, scale), SMALL if scale == "small" else SAPOConfig())
