"""Tasks and what tasks are made of. One task, one file."""

from rewax.envs.registry import list_envs, make, register
from rewax.envs.rolling_flat import make_rolling_flat

register("RollingFlat", make_rolling_flat)

__all__ = ["list_envs", "make", "register"]
