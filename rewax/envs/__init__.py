"""Tasks and the parts that tasks share. Each task has a file of its own, imported when the task is first made."""

from rewax.envs.base import ArraySpec, Env, State, failed_leaf_name, first_state, next_state
from rewax.envs.leaves import EnvLeaves, stack
from rewax.envs.randomized import Randomized
from rewax.envs.registry import list_envs, make, register
from rewax.envs.wrappers import AutoReset, Vmap

register("RollingFlat", {scale: f"rewax.envs.tasks.rolling_flat:{scale}" for scale in ("paper", "small")})
register("HandFlip", {scale: f"rewax.envs.tasks.hand_flip:{scale}" for scale in ("paper", "small")})
register("HandLift", {scale: f"rewax.envs.tasks.hand_lift:{scale}" for scale in ("paper", "small")})
register("FluidMove", {scale: f"rewax.envs.tasks.fluid_move:{scale}" for scale in ("paper", "small")})
register("SoftJumper", {scale: f"rewax.envs.tasks.soft_jumper:{scale}" for scale in ("paper", "small")})
register("SoftJumperMPM", {scale: f"rewax.envs.tasks.soft_jumper_mpm:{scale}" for scale in ("paper", "small")})
register("GripperLift", {scale: f"rewax.envs.tasks.gripper_lift:{scale}" for scale in ("paper", "small")})
register("SteerFloat", {scale: f"rewax.envs.tasks.steer_float:{scale}" for scale in ("paper", "small")})
register("WhipRope", {scale: f"rewax.envs.tasks.whip_rope:{scale}" for scale in ("paper", "small")})
register("CoverBox", {scale: f"rewax.envs.tasks.cover_box:{scale}" for scale in ("paper", "small")})
register("FoldCloth", {scale: f"rewax.envs.tasks.fold_cloth:{scale}" for scale in ("paper", "small")})
register("PourBag", {scale: f"rewax.envs.tasks.pour_bag:{scale}" for scale in ("paper", "small")})
register("AntRun", "rewax.envs.tasks.ant_run:make_ant_run")
register("HandReorient", "rewax.envs.tasks.hand_reorient:make_hand_reorient")
register("Ant", "rewax.envs.tasks.ant_run:make_ant")
register("CartpoleSwingUp", "rewax.envs.tasks.cartpole:make_cartpole_swing_up")
register("Hopper", "rewax.envs.tasks.hopper:make_hopper")
register("HalfCheetah", "rewax.envs.tasks.half_cheetah:make_half_cheetah")
register("Humanoid", "rewax.envs.tasks.humanoid:make_humanoid")
register("Quadruped", "rewax.envs.tasks.quadruped:make_quadruped")

__all__ = [
    "ArraySpec", "AutoReset", "Env", "EnvLeaves", "Randomized", "State", "Vmap", "failed_leaf_name", "first_state",
    "list_envs", "make", "next_state", "register", "stack",
]  # fmt: skip
