"""Base of tasks on particles and cloth in contact with each other, whose held vertices and grasps follow the joints."""

from typing import Any, ClassVar, cast

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.appearance import soft_appearance, soft_values
from rewax.envs.kit.soft_body import soft_at_rest
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.kit.thin_task import ThinTask
from rewax.envs.kit.worlds import soft_world, thin_world
from rewax.physics import coupling, thin
from rewax.physics.contact import Collider, drawings
from rewax.physics.coupling import MixedScene, MixedState, mixed
from rewax.physics.numerics import Pose
from rewax.physics.thin import ThinScene
from rewax.sensors.world import World
from rewax.types import Array, Observation


@struct.dataclass
class MixedTask(ThinTask):
    """A ``ThinTask`` on one ``MixedScene``.

    Subclasses define the methods that ``ThinTask`` lists. Points are the particles, then the vertices:
    ``rest_positions`` and pictures hold both. ``cloud`` chooses among the particles, and ``physics.soft`` is a
    ``MixedState``.

    Attributes:
      scene: particles, cloth and their contact. Pictures and sensors show ``seen_colliders``.
      vertex_stride: distance between the indices of two observed vertices (static).
    """

    scene: MixedScene  # pyright: ignore[reportIncompatibleVariableOverride]
    vertex_stride: int = struct.static_field(default=1)
    kinds: ClassVar[dict[type, type]] = {MixedScene: MixedState}

    def observe(self, physics: SoftPhysics) -> Observation:
        """Observed particles and vertices, and the joints with their motion."""
        vector = jnp.concatenate([physics.joint_q, physics.joint_qd])
        return {"particle_q": self.observed(physics), "cloth_q": self.observed_cloth(physics), "vector": vector}

    def observed_cloth(self, physics: SoftPhysics) -> Array:
        """Every ``vertex_stride``-th vertex [m], shape (num_observed, 3)."""
        return self.vertices(physics)[:: self.vertex_stride]

    # --- Particles and vertices in the places of ThinTask's ---

    @property
    def num_particles(self) -> int:
        return self.rest_positions.shape[-2] - self.thin_scene.mass.shape[-1]

    @property
    def thin_scene(self) -> ThinScene:
        return self.scene.thin

    def at_rest(self, positions: Array) -> MixedState:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The state of undeformed particles and of vertices at these positions [m] with velocity zero."""
        particles = soft_at_rest(self.scene.particles, positions[: self.num_particles])
        return MixedState(particles=particles, thin=thin.initial_state(positions[self.num_particles :]))  # pyright: ignore[reportArgumentType]

    def opened(self, soft: MixedState, bodies: Pose) -> MixedState:
        return soft.replace(thin=thin.open_grasps(self.scene.thin, soft.thin, bodies))

    def vertices(self, physics: SoftPhysics) -> Array:
        return _both(physics).thin.x

    def stepped(self, scene: MixedScene, soft: MixedState, poses: Pose, **driven: Any) -> tuple[MixedState, Array]:
        end = coupling.step_prescribed(scene, soft, poses, **driven)
        return end, mixed.check_status(scene, end, poses=poses)

    def points(self, physics: SoftPhysics) -> tuple[Array, Array]:
        """Positions and velocities of the particles."""
        return _both(physics).particles.x, _both(physics).particles.v

    # --- Pictures and sensors ---

    def particles(self, physics: SoftPhysics) -> Array:
        return jnp.concatenate([_both(physics).particles.x, _both(physics).thin.x])

    def particle_values(self, physics: SoftPhysics) -> dict[str, Array]:
        """The speed of particles and vertices [m/s]."""
        speeds = [soft_values(part)["speed"] for part in (_both(physics).particles, _both(physics).thin)]
        return {"speed": jnp.concatenate(speeds)}

    @property
    def appearance(self) -> dict[str, Any]:
        loose, thin_part = (soft_appearance(part, self.up) for part in (self.scene.particles, self.scene.thin))
        first, vertices, names = self.num_particles, self.thin_scene.mass.shape[-1], thin_part["material_names"]
        materials = [
            len(names) + loose.get("materials", np.zeros(first, int)),
            thin_part.get("materials", np.zeros(vertices, int)),
        ]
        elements = {name: first + thin_part[name] for name in ("triangles", "segments") if name in thin_part}
        own = {
            "material_names": (*names, *loose["material_names"]),
            "materials": np.concatenate(materials),
            "thickness": self.thickness,
            "camera": self.camera,
        }
        return {**thin_part, **loose, **elements, **own}

    def render_shapes(self, physics: SoftPhysics) -> list[dict[str, Any]]:
        """Drawings of ``seen_colliders``, and a ball at each held vertex and at each grasp."""
        shown = drawings(self.seen_colliders, self._bodies(physics.joint_q))
        return [*shown, *self.holders(physics)]

    def world(self, physics: SoftPhysics, up: np.ndarray) -> World:
        loose = soft_world(self.scene.particles, _both(physics).particles, up)
        sheets = thin_world(self.scene.thin, _both(physics).thin, self.thickness)
        world = loose.replace(balls=(*loose.balls, *sheets.balls), triangles=sheets.triangles)
        return self._with_tools(world, physics)

    @property
    def seen_colliders(self) -> tuple[Collider, ...]:
        """Colliders of the particles, and those of the cloth on other bodies."""
        loose, others = self.scene.particles.colliders, self.scene.thin.colliders
        bodies = {collider.body for collider in loose}
        return (*loose, *(collider for collider in others if collider.body not in bodies))


def _both(physics: SoftPhysics) -> MixedState:
    return cast(MixedState, physics.soft)


__all__ = ["MixedTask"]
