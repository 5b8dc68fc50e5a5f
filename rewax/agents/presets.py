"""Configurations by algorithm, environment and scale.

SAPO's presets come first. The presets of other algorithms have the same networks, environments and number of control
steps; their other settings are the defaults in ``rewax.agents.<algorithm>``. Those of ``small`` were adjusted by hand,
with unequal numbers of trials for the algorithms (docs/measured/small_suite.md).
"""

import dataclasses
from typing import TypeVar

from rewax.agents.agpo import AGPOConfig
from rewax.agents.ahac import AHACConfig
from rewax.agents.apg import APGConfig
from rewax.agents.config import RunConfig, Value
from rewax.agents.demonstrated import DemonstratedConfig
from rewax.agents.flash_sac import FlashSACConfig
from rewax.agents.ivw import IVWConfig
from rewax.agents.ppo import PPOConfig
from rewax.agents.rpo import RPOConfig
from rewax.agents.sac import SACConfig
from rewax.agents.sapo import SAPOConfig
from rewax.agents.shac import SHACConfig
from rewax.agents.trajopt import TrajOptConfig
from rewax.envs.registry import list_envs, make

C = TypeVar("C", bound=RunConfig)

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
    quick_compile=True,
)
"""For two cores: small networks and short rollouts. The temperature is small, because rewards differ by 0.01. The runs
are so short that a quick compilation saves more time than faster iterations."""

_RUNNER = SAPOConfig(
    num_envs=64, num_iterations=5000, actor_widths=(128, 64, 32), critic_widths=(64, 64), vector_features=0
)
"""The paper's settings for AntRun and the dflex suite: 64 environments, 10 million steps, no encoder."""
_HUMANOID = dataclasses.replace(_RUNNER, actor_widths=(256, 128), critic_widths=(128, 128))
_CARTPOLE = dataclasses.replace(_RUNNER, actor_widths=(64, 64), critic_widths=(64, 64))


def _small(paper: SAPOConfig, **changes: Value) -> SAPOConfig:
    """The same networks after a first layer for the observation, fewer environments and iterations, for two cores.

    Memory suffices for ``full``.
    """
    small = {"num_envs": 32, "num_iterations": 300, "vector_features": 64, "initial_temperature": 0.1}
    shared = {"stagger_episodes": True, "differentiate": "full"}
    return dataclasses.replace(paper, **{**small, **shared, **changes})


_WARM = dataclasses.replace(SMALL, initial_temperature=0.03)
"""For tasks whose rewards differ by 0.1 to 1 between good and bad actions: with ``SMALL`` their policies stop exploring
early, and the return depends on the seed."""

_JUMPER = dataclasses.replace(
    SMALL,
    num_envs=16,
    horizon=32,
    num_iterations=200,
    critic_minibatches=4,
    initial_temperature=1.0,
    quick_compile=False,
)

_SAPO: dict[tuple[str, str], SAPOConfig] = {
    ("RollingFlat", "paper"): SAPOConfig(num_iterations=4000),
    ("RollingFlat", "small"): SMALL,
    ("FluidMove", "paper"): SAPOConfig(num_iterations=4000),
    ("FluidMove", "small"): dataclasses.replace(SMALL, initial_log_std=-1.0, max_env_grad_norm=0.05),
    ("HandFlip", "paper"): SAPOConfig(num_iterations=6000),
    ("HandFlip", "small"): SMALL,
    ("HandLift", "paper"): SAPOConfig(num_iterations=6000),
    ("HandLift", "small"): dataclasses.replace(SMALL, max_env_grad_norm=0.3),
    ("SoftJumper", "paper"): SAPOConfig(num_iterations=6000),
    ("SoftJumper", "small"): _JUMPER,
    ("SoftJumperMPM", "paper"): SAPOConfig(num_iterations=6000),
    ("SoftJumperMPM", "small"): dataclasses.replace(_JUMPER, num_iterations=100, initial_temperature=0.02),
    ("SteerFloat", "small"): dataclasses.replace(SMALL, num_iterations=160),
    ("GripperLift", "small"): dataclasses.replace(SMALL, num_iterations=60, max_env_grad_norm=0.3),
    ("WhipRope", "small"): dataclasses.replace(
        _WARM, num_envs=16, horizon=32, num_iterations=80, critic_minibatches=4, discount=0.95
    ),
    ("CoverBox", "small"): dataclasses.replace(SMALL, horizon=10, num_iterations=360, max_env_grad_norm=0.3),
    ("FoldCloth", "small"): dataclasses.replace(_WARM, horizon=10, num_iterations=400, max_env_grad_norm=0.3),
    ("PourBag", "small"): dataclasses.replace(SMALL, horizon=20, num_iterations=40, max_env_grad_norm=0.3),
    ("AntRun", "paper"): dataclasses.replace(_RUNNER, num_iterations=2000),
    ("AntRun", "small"): _small(_RUNNER, max_env_grad_norm=2.0),
    ("Ant", "paper"): _RUNNER,
    ("Ant", "small"): _small(_RUNNER, max_env_grad_norm=3.0),
    ("CartpoleSwingUp", "paper"): _CARTPOLE,
    ("CartpoleSwingUp", "small"): _small(_CARTPOLE, num_iterations=600),
    ("HalfCheetah", "paper"): _RUNNER,
    ("HalfCheetah", "small"): _small(_RUNNER, max_env_grad_norm=20.0),
    ("HandReorient", "paper"): SAPOConfig(num_envs=64, num_iterations=2000, vector_features=0),
    ("HandReorient", "small"): _small(_HUMANOID, num_iterations=800, max_env_grad_norm=1.0),
    ("Hopper", "paper"): _RUNNER,
    ("Hopper", "small"): _small(_RUNNER, num_iterations=400),
    ("Humanoid", "paper"): _HUMANOID,
    ("Humanoid", "small"): _small(_HUMANOID, max_env_grad_norm=10.0),
    ("Quadruped", "paper"): _HUMANOID,
    ("Quadruped", "small"): _small(_HUMANOID),
}

_SIZES = (
    "num_envs",
    "horizon",
    "num_iterations",
    "actor_widths",
    "critic_widths",
    "point_widths",
    "point_features",
    "vector_features",
    "stagger_episodes",
    "critic_passes",
    "critic_minibatches",
    "differentiate",
    "max_env_grad_norm",
    "quick_compile",
)
"""Options that all algorithms copy from SAPO's presets, if they have them."""
_NO_GRADIENT = {"quick_compile": False}
"""Algorithms without a gradient of the simulation compile fast. quick_compile makes their updates a fifth slower."""
_FAST_CRITICS: dict[str, dict[str, Value]] = {
    name: {"critic_learning_rate": 2e-3} for name in ("AntRun", "Ant", "Hopper")
}
"""Tasks where SHAC's critics have a larger learning rate than the default, as in Rewarped. AHAC, which Rewarped
does not have, takes it from SHAC."""
_SAPOS_ACTOR: dict[str, Value] = {"activation": "silu", "initial_gain": 1.0, "state_dependent_std": True}
_SHORT_RUNS: dict[str, Value] = _SAPOS_ACTOR | {"target_decay": 0.2}
"""SHAC and AHAC in runs of a few hundred iterations: SAPO's layers, and a target network that follows in a few."""
_LARGE_RETURNS: dict[str, dict[str, Value]] = {
    "CartpoleSwingUp": {"normalize_rewards": True, "initial_temperature": 0.01}
}
"""Tasks with discounted returns of thousands. Without normalised rewards SAC starts slowly on them."""
_LOCOMOTION = ("AntRun", "Ant", "CartpoleSwingUp", "HalfCheetah", "Hopper", "Humanoid", "Quadruped")
"""Tasks with chaotic episodes: a sequence of actions needs a small learning rate."""


def sapo_preset(env_name: str, scale: str) -> SAPOConfig:
    """Hyper-parameters of SAPO for a registered environment. Without tuned values: the defaults of the scale.

    Raises:
      ValueError: there is no such scale.
    """
    if scale not in ("paper", "small"):
        raise ValueError(f"there is no scale {scale!r}: use paper or small")
    return _SAPO.get((env_name, scale), SMALL if scale == "small" else SAPOConfig())


def shac_preset(env_name: str, scale: str) -> SHACConfig:
    """Hyper-parameters of SHAC; see ``sapo_preset``.

    At ``small`` the actor has SAPO's activation, initial gain and state-dependent standard deviation, which begins at
    exp(-1), and the target network follows fast. It also does at ``paper`` where the critics learn fast.
    """
    changes: dict[str, Value] = dict(_SHORT_RUNS) if scale == "small" else {}
    if env_name in _FAST_CRITICS:
        changes |= _FAST_CRITICS[env_name] | {"target_decay": 0.2}
    return _sized(SHACConfig, sapo_preset(env_name, scale), **changes)


def apg_preset(env_name: str, scale: str) -> APGConfig:
    """Hyper-parameters of APG with a short horizon; see ``sapo_preset``. At ``small`` its actor is SHAC's."""
    changes = _SAPOS_ACTOR if scale == "small" else {}
    return _sized(APGConfig, sapo_preset(env_name, scale), **changes)


def apg_full_preset(env_name: str, scale: str) -> APGConfig:
    """Hyper-parameters of APG over whole episodes; see ``sapo_preset``."""
    base = sapo_preset(env_name, scale)
    iterations = _whole_episodes(env_name, scale, base)
    return _sized(APGConfig, base, horizon=0, num_iterations=iterations, differentiate="checkpointed")


def rpo_preset(env_name: str, scale: str) -> RPOConfig:
    """Hyper-parameters of RPO; see ``sapo_preset``.

    ``max_env_grad_norm`` is SAPO's, too, though RPO applies it to derivatives by actions.
    """
    return _sized(RPOConfig, sapo_preset(env_name, scale))


def ahac_preset(env_name: str, scale: str) -> AHACConfig:
    """Hyper-parameters of AHAC. Its horizon starts as SAPO's and may double; see ``sapo_preset``.

    At ``small`` actor and target network are those of ``shac_preset``. On Hopper each environment's gradient has a
    limit there: without it, that of one of five seeds is a hundred times as large. On AntRun at ``paper`` the horizon
    may only shrink, and the actor follows the mean of the critics: otherwise the policy earns less.
    """
    base = sapo_preset(env_name, scale)
    changes: dict[str, Value] = dict(_SHORT_RUNS) if scale == "small" else {}
    longest = 2 * base.horizon
    if (env_name, scale) == ("Hopper", "small"):
        changes |= {"max_env_grad_norm": 10.0}
    elif (env_name, scale) == ("AntRun", "paper"):
        changes |= {"actor_value": "mean"}
        longest = base.horizon
    changes |= {"horizon": longest, "initial_horizon": base.horizon, "min_horizon": base.horizon // 4}
    return _sized(AHACConfig, base, **changes, **_FAST_CRITICS.get(env_name, {}))


def ppo_preset(env_name: str, scale: str) -> PPOConfig:
    """Hyper-parameters of PPO. At ``small``: more environments, fewer iterations; see ``sapo_preset``."""
    base = sapo_preset(env_name, scale)
    if scale == "paper":
        return _sized(PPOConfig, base, **_NO_GRADIENT)
    more = max(1, 1024 // base.samples)
    return _sized(
        PPOConfig,
        base,
        num_envs=more * base.num_envs,
        num_iterations=max(1, base.num_iterations // more),
        minibatches=4,
        epochs=10,
        target_kl=0.02,
        **_NO_GRADIENT,
    )


def sac_preset(env_name: str, scale: str) -> SACConfig:
    """Hyper-parameters of SAC; see ``sapo_preset``."""
    base = sapo_preset(env_name, scale)
    if scale == "paper":
        return _sized(SACConfig, base, batch_size=2048 if base.num_envs == 64 else 1024, **_NO_GRADIENT)
    rates = dict.fromkeys(("actor_learning_rate", "final_learning_rate", "critic_learning_rate"), 1e-3)
    sizes = {"batch_size": 256, "updates": 32, "target_rate": 0.02, "replay_size": 100_000}
    return _sized(SACConfig, base, **sizes, **rates, **_LARGE_RETURNS.get(env_name, {}), **_NO_GRADIENT)


def flash_sac_preset(env_name: str, scale: str) -> FlashSACConfig:
    """Hyper-parameters of FlashSAC; see ``sapo_preset``."""
    base = sapo_preset(env_name, scale)
    if scale == "paper":
        return _sized(FlashSACConfig, base, **_NO_GRADIENT)
    rates = dict.fromkeys(("actor_learning_rate", "final_learning_rate", "critic_learning_rate"), 1e-3)
    rates |= {"temperature_learning_rate": 5e-3, "target_rate": 0.02}
    sizes = {"batch_size": 512, "updates": 32, "replay_size": 100_000}
    return _sized(FlashSACConfig, base, **sizes, **rates, **_NO_GRADIENT)


def trajopt_preset(env_name: str, scale: str) -> TrajOptConfig:
    """Hyper-parameters of TrajOpt; see ``sapo_preset``."""
    base = sapo_preset(env_name, scale)
    return TrajOptConfig(
        num_envs=base.num_envs,
        num_iterations=_whole_episodes(env_name, scale, base),
        learning_rate=_sequence_rate(env_name, scale),
    )


def demonstrated_preset(env_name: str, scale: str) -> DemonstratedConfig:
    """Hyper-parameters of SAPO from demonstrations. The sequence has half of TrajOpt's iterations, twice its rate."""
    base = sapo_preset(env_name, scale)
    options = {field.name: getattr(base, field.name) for field in dataclasses.fields(base)}
    options |= {"initial_log_std": min(base.initial_log_std, -1.0)}
    return DemonstratedConfig(**options, sequence_learning_rate=2.0 * _sequence_rate(env_name, scale))


def ivw_preset(env_name: str, scale: str) -> IVWConfig:
    """Hyper-parameters of SAPO with weighted steps: those of ``sapo_preset``."""
    return IVWConfig(**dataclasses.asdict(sapo_preset(env_name, scale)))


def agpo_preset(env_name: str, scale: str) -> AGPOConfig:
    """Hyper-parameters of SAPO with mixed gradients: those of ``sapo_preset``."""
    return AGPOConfig(**dataclasses.asdict(sapo_preset(env_name, scale)))


def _sequence_rate(env_name: str, scale: str) -> float:
    """Learning rate of a sequence of actions."""
    fast = env_name == "HandReorient" or (scale == "small" and env_name not in _LOCOMOTION)
    if env_name == "CartpoleSwingUp":  # chaotic within half a second at full force: gradients of 1e4 and more
        return 1e-3
    if env_name == "FluidMove":  # faster, a sequence lifts the container to the limit of its joint, and stays there
        return 1e-2
    return 0.1 if fast else 1e-2


def _whole_episodes(env_name: str, scale: str, base: SAPOConfig) -> int:
    """Number of iterations of whole episodes that take as many control steps as SAPO's preset."""
    length = make(env_name, scale=scale).episode_length if env_name in list_envs() else base.horizon
    return max(1, base.num_iterations * base.horizon // length)


def _sized(config_type: type[C], base: SAPOConfig, **changes: Value) -> C:
    names = {field.name for field in dataclasses.fields(config_type)} & set(_SIZES)
    return dataclasses.replace(config_type(), **{name: getattr(base, name) for name in names} | changes)
