"""Reinforcement learning through differentiable multiphysics, in JAX.

Names are imported when they are first used: ``import rewax`` alone loads neither JAX nor a simulator.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rewax.envs import list_envs, make, register
    from rewax.envs.base import ArraySpec, Env, State
    from rewax.envs.wrappers import AutoReset, Vmap
    from rewax.status import Status
    from rewax.struct import replace_leaf
    from rewax.training.storage.policies import list_policies, load_policy

__version__ = "0.1.0"

_HOMES = {
    **dict.fromkeys(("list_envs", "make", "register"), "rewax.envs"),
    **dict.fromkeys(("ArraySpec", "Env", "State"), "rewax.envs.base"), "replace_leaf": "rewax.struct",
    **dict.fromkeys(("AutoReset", "Vmap"), "rewax.envs.wrappers"), "Status": "rewax.status",
    **dict.fromkeys(("list_policies", "load_policy"), "rewax.training.storage.policies"),
}  # fmt: skip
_MODULES = ("adapters", "agents", "debug", "envs", "physics", "struct", "testing", "training", "viz")
__all__ = ["ArraySpec", "AutoReset", "Env", "State", "Status", "Vmap", "list_envs", "list_policies", "load_policy",
           "make", "register", "replace_leaf"]  # fmt: skip
importlib.import_module("rewax.xla_options").warn_of_wrong_gradients()


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"rewax.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'rewax' has no attribute {name!r}")
    return globals().setdefault(name, getattr(importlib.import_module(_HOMES[name]), name))


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, *_MODULES})
