"""Base of tasks with a soft body, whether a robot or prescribed tools move it: observation, status, pictures."""

from typing import Any, ClassVar, TypeAlias

import numpy as np

from rewax.envs.kit.appearance import soft_appearance, soft_values
from rewax.envs.kit.checks import checked_observation
from rewax.envs.kit.options import integer_option
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.start_noise import ResetNoise
from rewax.envs.kit.task import Task, against
from rewax.physics import mpm, tets, thin
from rewax.physics.mpm import MPMScene, MPMState
from rewax.physics.numerics import Pose
from rewax.physics.numerics.arguments import check_instance, real_array
from rewax.physics.numerics.fields import check_fields, instance
from rewax.physics.tets import TetScene, TetState
from rewax.physics.thin import ThinScene, ThinState
from rewax.types import Array, Key, Observation, Vector

Scene: TypeAlias = MPMScene | TetScene | ThinScene
Soft: TypeAlias = MPMState | TetState | ThinState


def _check_points(name: str, value: Any) -> None:
    remedy = "give positions in metres, shape (num_points, 3)"
    shape = real_array(name, value, remedy).shape
    if len(shape) < 2 or shape[-1] != 3:
        raise ValueError(f"{name} has shape {shape}: {remedy}")


_FIELDS = {
    "rest_positions": _check_points,
    "noise": instance(ResetNoise, "give reset_noise(lower, upper), or leave it out for none"),
    "cloud": instance(PointCloud, "give PointCloud(num_points=...)"),
}


class SoftBodyTask(Task):
    """Base of ``SoftTask`` and ``CoupledTask``. Their physics has the field ``soft``: particles, or vertices.

    ``noise_fields`` names the fields that are 0 in a task without noise of a reset. ``rewax.identify`` sets them to 0.
    A task whose ``start`` draws more of its soft body names the sizes of these draws, too. ``kinds`` holds the class of
    the state for each class of scene.
    """

    scene: Scene
    rest_positions: Vector
    noise: ResetNoise
    cloud: PointCloud
    noise_fields: ClassVar[tuple[str, ...]] = ("noise",)
    kinds: ClassVar[dict[type, type]] = {MPMScene: MPMState, TetScene: TetState, ThinScene: ThinState}

    def __post_init__(self) -> None:
        super().__post_init__()
        names = " or ".join(kind.__name__ for kind in self.kinds)
        check_instance("scene", self.scene, tuple(self.kinds), f"give one of the class {names}")
        check_fields(_FIELDS, vars(self))

    @property
    def soft_kind(self) -> type:
        """Class of the state of the soft body."""
        return next(state for scene, state in self.kinds.items() if isinstance(self.scene, scene))

    def points(self, physics: Any) -> tuple[Array, Array]:
        """Positions and velocities of all points, in the frame and the units of the observation, shape (num_points, 3)
        each.
        """
        return physics.soft.x, physics.soft.v

    def seen(self, physics: Any, key: Key) -> tuple[Observation, Key]:
        return self.cloud.shown(checked_observation(self, self.observe(physics)), self.points(physics), key)

    def observed(self, physics: Any) -> Array:
        """The fixed points of the cloud, shape (num_points, 3): without noise, for rewards too."""
        return self.cloud.pick(self.points(physics)[0])

    def particles(self, physics: Any) -> Array:
        """Positions for pictures [m], shape (num_points, 3)."""
        return physics.soft.x

    def particle_values(self, physics: Any) -> dict[str, Array]:
        """Numbers that colour the points in pictures, shape (num_points,) each: ``speed`` [m/s], ``strain`` [-]."""
        return soft_values(physics.soft)

    @property
    def appearance(self) -> dict[str, Any]:
        """How pictures show the soft body, its floor and the camera; see ``rewax.viz.recording``."""
        return {**soft_appearance(self.scene, self.up), "camera": self.camera}

    @property
    def up(self) -> np.ndarray:
        """Unit vector opposite to gravity, for pictures, shape (3,); y if gravity is zero."""
        return against(self.scene.gravity, (0.0, 1.0, 0.0))


def soft_at_rest(scene: Scene, positions: Array) -> Soft:
    """The state of undeformed particles, or of vertices, at these positions [m] with velocity zero."""
    if isinstance(scene, TetScene):
        return tets.initial_state(positions)
    if isinstance(scene, ThinScene):
        return thin.initial_state(positions)
    materials = scene.material if isinstance(scene.material, tuple) else (scene.material,)
    return mpm.initial_state(positions, scene if any(m.initial_memory for m in materials) else None)


def soft_status(scene: Scene, soft: Soft, *, start: Soft, poses: Pose | None = None) -> Array:
    """Status bits after a step that began at ``start``; see ``check_status`` of ``mpm``, ``tets`` and ``thin``."""
    if isinstance(scene, TetScene):
        assert isinstance(soft, TetState)
        return tets.check_status(scene, soft, poses=poses)
    if isinstance(scene, ThinScene):
        assert isinstance(soft, ThinState)
        return thin.check_status(scene, soft, poses=poses)
    assert isinstance(soft, MPMState) and isinstance(start, MPMState)
    return mpm.check_status(scene, soft, start=start, poses=poses)


def check_list_every(list_every: int | None, num_substeps: int) -> None:
    """Raises ValueError unless ``list_every`` is None or a divisor of ``num_substeps``."""
    if list_every is None:
        return
    integer_option("list_every", list_every, "give a divisor of num_substeps, or None for a whole control step")
    if num_substeps % list_every:
        raise ValueError(
            f"list_every is {list_every}, which does not divide num_substeps = {num_substeps}: choose a divisor, or "
            "None"
        )


__all__ = ["Scene", "Soft", "SoftBodyTask", "check_list_every", "soft_at_rest", "soft_status"]
