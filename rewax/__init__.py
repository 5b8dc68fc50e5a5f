"""Reinforcement learning through differentiable multiphysics, in JAX."""

from rewax.envs import list_envs, make, register
from rewax.envs.base import ArraySpec, Env, State
from rewax.envs.wrappers import AutoReset, Vmap
from rewax.status import Status

__version__ = "0.1.0"

__all__ = ["ArraySpec", "AutoReset", "Env", "State", "Status", "Vmap", "list_envs", "make", "register"]
