"""Tasks and what tasks are made of. One task, one file."""

from rewax.envs.ant_run import make_ant, make_ant_run
from rewax.envs.dflex.cartpole import make_cartpole_swing_up
from rewax.envs.dflex.half_cheetah import make_half_cheetah
from rewax.envs.dflex.hopper import make_hopper
from rewax.envs.dflex.humanoid import make_humanoid
from rewax.envs.hand_reorient import make_hand_reorient
from rewax.envs.quadruped import make_quadruped
from rewax.envs.registry import list_envs, make, register
from rewax.envs.rolling_flat import make_rolling_flat

register("RollingFlat", make_rolling_flat)
register("AntRun", make_ant_run)
register("HandReorient", make_hand_reorient)
register("Ant", make_ant)
register("CartpoleSwingUp", make_cartpole_swing_up)
register("Hopper", make_hopper)
register("HalfCheetah", make_half_cheetah)
register("Humanoid", make_humanoid)
register("Quadruped", make_quadruped)

__all__ = ["list_envs", "make", "register"]
