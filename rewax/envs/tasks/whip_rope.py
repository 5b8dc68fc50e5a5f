"""WhipRope: a hand swings a rope so that the rope's free end hits a target.

The target is out of reach of the hanging rope. The hand has to swing the rope, or to crack it like a whip. The gradient
leads from the free end through all segments back to the hand's motion.
"""

from typing import Any

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.envs.kit.appearance import MARKER
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.set_points import Following
from rewax.envs.kit.soft_body import Soft
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.physics import thin
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Key, Observation, PyTree, Scalar, Vector

HAND = (0.0, 1.2, 0.0)
"""Start of the hand, y up [m]."""
LENGTH = 0.8
"""Length of the rope [m]."""
HIT = 0.05
"""Largest distance of a hit [m]."""


@struct.dataclass
class Aim(struct.Replaceable):
    """The task's part of the state.

    Attributes:
      target: [m], shape (3,).
      nearest: least distance of the free end from it so far [m].
      soft_nearest: a smooth minimum of the distances so far [m], see ``WhipRope.reward``.
    """

    target: Vector
    nearest: Scalar
    soft_nearest: Scalar


@struct.dataclass
class WhipRope(Following):
    """The task; ``rewax.make("WhipRope", scale=...)`` builds it.

    The joints are the position of the hand [m], which holds the first vertex. An action is a set point between the
    limits of the joints. The hand follows it without jumps of its velocity, which would send waves through the rope.
    ``physics.task`` is an ``Aim``.

    Attributes:
      distance, azimuth, elevation: range of the target around the start of the hand [m, rad], shape (2,); azimuth 0
        is along x, and elevation 0 is level.
      unit: how much nearer the free end has to come for a reward of 1 [m].
      blur: distances that differ by less count alike in the smooth minimum [m].
    """

    distance: Vector
    azimuth: Vector
    elevation: Vector
    unit: Scalar
    blur: Scalar

    def start(self, positions: Array, key: Key) -> tuple[Soft, PyTree]:
        draws = [
            jax.random.uniform(k, (), minval=bounds[0], maxval=bounds[1])
            for k, bounds in zip(jax.random.split(key, 3), (self.distance, self.azimuth, self.elevation), strict=True)
        ]
        away, around, above = draws
        level = away * jnp.cos(above)
        shift = jnp.stack([level * jnp.cos(around), away * jnp.sin(above), level * jnp.sin(around)])
        target = self.joint_start + shift
        distance = _distance(positions[-1], target)
        return self.at_rest(positions), Aim(target=target, nearest=distance, soft_nearest=distance)

    def set_point(self, physics: SoftPhysics, action: Array) -> Array:
        """The place in the box of the joints' limits that the action names; ``joint_step`` is not used."""
        del physics
        return self.joint_lower + 0.5 * (1.0 + action) * (self.joint_upper - self.joint_lower)

    def pins(self, physics: SoftPhysics, joint_q: Array) -> Array:
        del physics
        return joint_q[:, None]

    def points(self, physics: SoftPhysics) -> tuple[Array, Array]:
        return physics.soft.x - physics.joint_q, physics.soft.v

    def observe(self, physics: SoftPhysics) -> Observation:
        x, v, hand = physics.soft.x, physics.soft.v, physics.joint_q
        some = jnp.array([len(x) // 4, len(x) // 2, 3 * len(x) // 4, len(x) - 1])
        vector = jnp.concatenate(
            [
                (x[some] - hand).reshape(-1),
                0.2 * v[some].reshape(-1),
                hand - self.joint_start,
                0.2 * physics.joint_qd,
                physics.task.target - hand,
                physics.task.target - x[-1],
                physics.task.soft_nearest[None],
            ]
        )
        return {"particle_q": self.observed(physics), "vector": vector}

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """(m - m') / unit, with m = -blur log(sum_t exp(-d_t / blur)) before and m' after the control step.

        d_t = sqrt(|x - target|^2 + (1 cm)^2) is the distance of the free end from the target after control step t. m is
        a smooth minimum of all distances so far. So the return is about (d_0 - min d) / unit; time near the minimum
        adds up to blur log(1 + num_steps) / unit.
        """
        distance, aim = _distance(physics.soft.x[-1], physics.task.target), physics.task
        hit = jnp.minimum(distance, aim.nearest) < HIT
        metrics = {"distance": distance, "success": hit.astype(distance.dtype)}
        return (aim.soft_nearest - self._soft_nearest(aim, distance)) / self.unit, metrics

    def next_task(self, physics: SoftPhysics, key: Key) -> PyTree:
        del key
        aim, distance = physics.task, _distance(physics.soft.x[-1], physics.task.target)
        return aim.replace(nearest=jnp.minimum(aim.nearest, distance), soft_nearest=self._soft_nearest(aim, distance))

    def _soft_nearest(self, aim: Aim, distance: Array) -> Array:
        return -self.blur * jnp.logaddexp(-aim.soft_nearest / self.blur, -distance / self.blur)

    def render_shapes(self, physics: SoftPhysics) -> list[dict[str, Any]]:
        target = {"kind": "sphere", "center": physics.task.target, "radius": HIT, "color": MARKER, "opacity": 0.7}
        return [*super().render_shapes(physics), target]

    @property
    def appearance(self) -> dict[str, Any]:
        return {**super().appearance, "floor": 0.0}

    @property
    def camera(self) -> dict[str, Any]:
        return {"azimuth": 10.0, "elevation": 12.0}

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.3, 1.0, 0.0), 1.8, up=self.up)


def _distance(a: Array, b: Array) -> Array:
    """Distance of two points, rounded off below 1 cm [m]."""
    return jnp.sqrt(jnp.sum((a - b) ** 2) + 0.01**2)


def _whip_rope(steps: Substeps, *, num_segments: int, stretch: float, max_steps: int, cloud: PointCloud) -> WhipRope:
    fraction = jnp.linspace(0.0, 1.0, num_segments + 1)[:, None]
    points = jnp.asarray(HAND) - LENGTH * fraction * jnp.array([0.0, 1.0, 0.0])
    mesh = thin.rope(points)
    scene = thin.make_scene(
        mesh=mesh,
        dt=steps.dt,
        rope=thin.Rope(stretch=stretch, bending=5e-3, density=0.1, damping=2e-4),
        drag=0.5,
        held=[0],
    )
    return WhipRope(
        scene=scene,
        rest_positions=points,
        joint_start=HAND,
        joint_lower=(-0.3, 0.9, -0.3),
        joint_upper=(0.3, 1.5, 0.3),
        joint_step=(0.3, 0.3, 0.3),
        rate=10.0,
        distance=(0.75, 0.95),
        azimuth=(-0.5, 0.5),
        elevation=(-0.35, 0.5),
        unit=0.1,
        blur=0.03,
        thickness=0.02,
        cloud=cloud,
        num_substeps=steps.num,
        max_steps=max_steps,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> WhipRope:
    """A rope of 64 segments."""
    return _whip_rope(
        substeps(dt, num_substeps, Substeps(6.25e-5, 800)),
        num_segments=64,
        stretch=300.0,
        max_steps=60,
        cloud=PointCloud(num_points=65),
    )


def small(*, dt: float | None = None, num_substeps: int | None = None) -> WhipRope:
    """A rope of 16 segments, for two cores."""
    return _whip_rope(
        substeps(dt, num_substeps, Substeps(6.25e-4, 80)),
        num_segments=16,
        stretch=200.0,
        max_steps=32,
        cloud=PointCloud(num_points=17),
    )
