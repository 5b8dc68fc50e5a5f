"""Names for ``gymnasium.make``: ``rewax/RollingFlat-small-v0`` and the like, one for each task and scale.

gymnasium finds them by itself where rewax is installed (entry point ``gymnasium.envs``). Elsewhere
``import rewax.adapters.gymnasium_env`` registers them. This module imports neither JAX nor a task.
"""

TASKS = (
    "Ant", "AntRun", "CartpoleSwingUp", "CoverBox", "FluidMove", "FoldCloth", "GripperLift", "HalfCheetah", "HandFlip",
    "HandLift", "HandReorient", "Hopper", "Humanoid", "PourBag", "Quadruped", "RollingFlat", "SoftJumper",
    "SoftJumperMPM", "SteerFloat", "WhipRope",
)  # fmt: skip
"""The tasks of rewax, as ``rewax.list_envs`` names them."""
SCALES = ("paper", "small")


def register_envs() -> None:
    """Register ``rewax/{task}-{scale}-v0`` with gymnasium; names that it knows already stay as they are."""
    from gymnasium.envs.registration import register, registry

    for task in TASKS:
        for scale in SCALES:
            if (name := f"rewax/{task}-{scale}-v0") not in registry:
                register(
                    name,
                    entry_point="rewax.adapters.gymnasium_env:make_gymnasium_env",
                    vector_entry_point="rewax.adapters.gymnasium_env:make_gymnasium_vector_env",
                    kwargs={"task": task, "scale": scale},
                )


__all__ = ["SCALES", "TASKS", "register_envs"]
