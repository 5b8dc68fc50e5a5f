"""Tasks and what tasks are made of. One task, one file; a task's file is imported when the task is first made."""

from rewax.envs.base import ArraySpec, Env, State, failed_leaf_name, first_state, next_state
from rewax.envs.leaves import EnvLeaves, stack
from rewax.envs.randomized import Randomized
from rewax.envs.registry import list_envs, make, register
from rewax.envs.wrappers import AutoReset, Vmap

register("RollingFlat", {scale: f"rewax.envs.rolling_flat:{scale}" for scale in ("paper", "small")})
register("HandFlip", {scale: f"rewax.envs.hand_flip:{scale}" for scale in ("paper", "small")})
register("HandLift", {scale: f"rewax.envs.hand_lift:{scale}" for scale in ("paper", "small")})
register("FluidMove", {scale: f"rewax.envs.fluid_move:{scale}" for scale in ("paper", "small")})
register("SoftJumper", {scale: f"rewax.envs.soft_jumper:{scale}" for scale in ("paper", "small")})
register("SoftJumperMPM", {scale: f"rewax.envs.soft_jumper_mpm:{scale}" for scale in ("paper", "small")})
register("GripperLift", {scale: f"rewax.envs.gripper_lift:{scale}" for scale in ("paper", "small")})
register("SteerFloat", {scale: f"rewax.envs.steer_float:{scale}" for scale in ("paper", "small")})
register("AntRun", "rewax.envs.ant_run:make_ant_run")
register("HandReorient", "rewax.envs.hand_reorient:make_hand_reorient")
register("Ant", "rewax.envs.ant_run:make_ant")
register("CartpoleSwingUp", "rewax.envs.dflex.cartpole:make_cartpole_swing_up")
register("Hopper", "rewax.envs.dflex.hopper:make_hopper")
register("HalfCheetah", "rewax.envs.dflex.half_cheetah:make_half_cheetah")
register("Humanoid", "rewax.envs.dflex.humanoid:make_humanoid")
register("Quadruped", "rewax.envs.quadruped:make_quadruped")

__all__ = [
    "ArraySpec", "AutoReset", "Env", "EnvLeaves", "Randomized", "State", "Vmap", "failed_leaf_name", "first_state",
    "list_envs", "make", "next_state", "register", "stack",
]  # fmt: skip
