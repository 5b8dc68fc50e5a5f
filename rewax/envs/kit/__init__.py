"""The parts of tasks: base classes, parts of scenes, rewards, observations of point clouds.

Names are imported when they are first used.
"""

from typing import TYPE_CHECKING

from rewax.lazy import lazy_names

if TYPE_CHECKING:
    from rewax.envs.kit.coupled_task import CoupledPhysics, CoupledTask
    from rewax.envs.kit.mixed_task import MixedTask
    from rewax.envs.kit.point_cloud import PointCloud
    from rewax.envs.kit.rigid_task import RigidPhysics, RigidTask
    from rewax.envs.kit.soft_parts import box_walls, dough, water
    from rewax.envs.kit.soft_task import SoftPhysics, SoftTask
    from rewax.envs.kit.start_noise import ResetNoise, no_noise, reset_noise
    from rewax.envs.kit.task import Task
    from rewax.envs.kit.thin_task import ThinTask

_HOMES = {
    **dict.fromkeys(("CoupledPhysics", "CoupledTask"), "rewax.envs.kit.coupled_task"),
    "MixedTask": "rewax.envs.kit.mixed_task",
    "PointCloud": "rewax.envs.kit.point_cloud",
    **dict.fromkeys(("RigidPhysics", "RigidTask"), "rewax.envs.kit.rigid_task"),
    **dict.fromkeys(("box_walls", "dough", "water"), "rewax.envs.kit.soft_parts"),
    **dict.fromkeys(("SoftPhysics", "SoftTask"), "rewax.envs.kit.soft_task"),
    **dict.fromkeys(("ResetNoise", "no_noise", "reset_noise"), "rewax.envs.kit.start_noise"),
    "Task": "rewax.envs.kit.task",
    "ThinTask": "rewax.envs.kit.thin_task",
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)

__all__ = [
    "CoupledPhysics", "CoupledTask", "MixedTask", "PointCloud", "ResetNoise", "RigidPhysics", "RigidTask",
    "SoftPhysics", "SoftTask", "Task", "ThinTask", "box_walls", "dough", "no_noise", "reset_noise", "water",
]  # fmt: skip
