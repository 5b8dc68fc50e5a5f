"""Algorithms by name."""

import dataclasses
import difflib
import functools
import importlib
import keyword
import warnings
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from rewax.agents.base import Agent
from rewax.agents.config import RunConfig, Value
from rewax.envs.base import Env


class Algorithm(NamedTuple):
    """A registered algorithm, as training, the command line and saved runs use it.

    Attributes:
      make: ``(env, config) -> Agent``, with the keyword ``randomize`` of ``make_sapo``.
      config_type: frozen dataclass of hyper-parameters: a ``RunConfig``, or another with its fields.
      preset: ``(env_name, scale) -> config``: tuned hyper-parameters, or defaults.
      changes: options with another value than the default of ``config_type``, for ablations. ``make`` warns of
        a configuration that has other values of them.
    """

    make: Callable[..., Agent]
    config_type: type[RunConfig]
    preset: Callable[[str, str], RunConfig]
    changes: Mapping[str, Any] = MappingProxyType({})

    def defaults(self) -> RunConfig:
        """The configuration of ``make_agent`` without one."""
        return self.config_type(**self.changes)


def _own(name: str, config: str) -> Callable[[], Algorithm]:
    """An algorithm of this package, imported on first use."""

    def load() -> Algorithm:
        module = importlib.import_module(f"rewax.agents.{name}")
        presets = importlib.import_module("rewax.agents.presets")
        preset = getattr(presets, f"{name}_preset")
        return Algorithm(getattr(module, f"make_{name}"), getattr(module, config), preset)

    return load


def _variant(of: str, changes: Mapping[str, Value], preset: str = "") -> Callable[[], Algorithm]:
    """A registered algorithm with some options changed in its defaults and, unless there is a preset, in all of its."""

    def load() -> Algorithm:
        known = algorithm(of)
        presets = importlib.import_module("rewax.agents.presets")
        changed_preset = functools.partial(_changed_preset, known.preset, tuple(changes.items()))
        changed = known._replace(preset=getattr(presets, preset) if preset else changed_preset, changes=changes)
        return changed._replace(make=functools.partial(_make_variant, known.make, changed.defaults(), changes))

    return load


def _make_variant(
    make: Callable[..., Agent],
    defaults: RunConfig,
    changes: Mapping[str, Value],
    env: Env,
    config: RunConfig | None = None,
    **options: object,
) -> Agent:
    """Warns of a configuration that undoes the changes, with which it is the algorithm itself."""
    agent = make(env, defaults if config is None else config, **options)
    undone = [
        f"{name} {getattr(config, name)!r}, not {value!r}"
        for name, value in changes.items()
        if getattr(config, name, value) != value
    ]
    if undone:
        warnings.warn(
            f"the configuration has {', '.join(undone)}: begin with algorithm(name).defaults() or its preset, and "
            "change other options",
            stacklevel=3,
        )
    return agent


def _changed_preset(
    preset: Callable[[str, str], RunConfig], changes: tuple[tuple[str, Value], ...], env_name: str, scale: str
) -> RunConfig:
    """A preset with other values of some options."""
    return dataclasses.replace(preset(env_name, scale), **dict(changes))


_NO_ENTROPY = {
    "entropy_in_return": False, "entropy_in_targets": False, "entropy_in_loss": False, "learn_temperature": False,
}  # fmt: skip

_ALGORITHMS: dict[str, Callable[[], Algorithm]] = {
    "sapo": _own("sapo", "SAPOConfig"),
    "shac": _own("shac", "SHACConfig"),
    "apg": _own("apg", "APGConfig"),
    "ppo": _own("ppo", "PPOConfig"),
    "sac": _own("sac", "SACConfig"),
    "flash_sac": _own("flash_sac", "FlashSACConfig"),
    "trajopt": _own("trajopt", "TrajOptConfig"),
    "ahac": _own("ahac", "AHACConfig"),
    "rpo": _own("rpo", "RPOConfig"),
    "sapo_agpo": _own("agpo", "AGPOConfig"),
    "sapo_ivw": _own("ivw", "IVWConfig"),
    "sapo_from_demonstrations": _own("demonstrated", "DemonstratedConfig"),
    # The ablations of the paper's Table 3.
    "sapo_hard_targets": _variant("sapo", {"entropy_in_targets": False}),
    "sapo_hard_return": _variant("sapo", {"entropy_in_return": False}),
    "sapo_no_actor_entropy": _variant("sapo", {"entropy_in_return": False, "entropy_in_loss": False}),
    "shac2": _variant("sapo", _NO_ENTROPY),
    "apg_full": _variant("apg", {"horizon": 0}, "apg_full_preset"),
}

_OPTIONS = (
    "env", "scale", "env_from", "env_from_values", "sensors", "resolution", "algo", "imports", "seed", "num_seeds",
    "steps", "run_dir", "resume", "init_from", "devices", "distributed", "train",
)  # fmt: skip
"""Options of ``rewax train`` that are not an algorithm's."""


def register_algorithm(name: str, algorithm: Algorithm) -> None:
    """Register an algorithm for the command line and ``load_run``.

    Args:
      name: its name; must equal ``Agent.name`` of the agents it makes. Options of the command line begin with it, so
        it is an identifier of Python.
      algorithm: how to make it.

    Raises:
      ValueError: the name is no identifier, or is taken by another algorithm or by an option.
    """
    if not (isinstance(name, str) and name.isidentifier()) or keyword.iskeyword(name):
        raise ValueError(f"name is {name!r}: use letters, digits and _, because options begin with it")
    if name in _OPTIONS:
        raise ValueError(f"the name {name!r} is that of an option of rewax train: choose another name")
    if not isinstance(algorithm, Algorithm):
        raise ValueError(f"algorithm is {algorithm!r}: give an Algorithm(make=..., config_type=..., preset=...)")
    if name in _ALGORITHMS and _ALGORITHMS[name]() != algorithm:
        raise ValueError(f"an algorithm named {name!r} is registered already: choose another name")
    _ALGORITHMS[name] = lambda: algorithm


def list_algorithms() -> list[str]:
    """Names of all registered algorithms, sorted."""
    return sorted(_ALGORITHMS)


def algorithm(name: str) -> Algorithm:
    """A registered algorithm.

    Raises:
      ValueError: the name is not registered; the message lists the registered names.
    """
    if name not in _ALGORITHMS:
        close = difflib.get_close_matches(name, _ALGORITHMS, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ValueError(
            f"there is no algorithm named {name!r}: {hint}known are {', '.join(list_algorithms())}; one of "
            "your own needs the module that registers it, --import my_module"
        )
    return _ALGORITHMS[name]()


def build_agent(name: str, env: Env, config: RunConfig) -> Agent:
    """An agent of a registered algorithm.

    Raises:
      ValueError: there is no such algorithm, or its ``make`` returned something else than an agent.
    """
    agent = algorithm(name).make(env, config)
    if not isinstance(agent, Agent):
        raise ValueError(f"make of the algorithm {name!r} returned {agent!r}: return a rewax.agents.base.Agent")
    return agent


def make_agent(name: str, env: Env, config: RunConfig | None = None, **options: object) -> Agent:
    """An agent of a registered algorithm.

    Args:
      name: of ``list_algorithms()``.
      env: one environment without auto-reset, or a batch of ``num_envs`` environments.
      config: hyper-parameters; None: the defaults, and an ablation's changes of them.
      **options: of the algorithm's ``make``: ``randomize``.

    Raises:
      ValueError: there is no such algorithm, or it refuses the environment or the configuration.
    """
    known = algorithm(name)
    return known.make(env, known.defaults() if config is None else config, **options)
