"""The sense of touch: forces and torques of contact on bodies, a pure function of what was felt in the last step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics.contact import WALLS, Patches, Wrench
from rewax.physics.numerics.checks import FINITE, check_numbers, numbers_of
from rewax.physics.numerics.pose import turned
from rewax.sensors.world import World
from rewax.types import Array, Key, Vector

_FRAMES = ("world", "body")


@struct.dataclass
class Touch(struct.Replaceable):
    """Mean force and torque of contact on bodies in the last control step; zero after a reset.

    Contacts with particles, tetrahedra and other rigid bodies count, those with joint limits, actuators and equalities
    do not. The force is the impulse divided by the duration of the step.

    Attributes:
      bodies: names or indices of bodies, ``"walls"`` for walls and ground (static). None: all that can touch, without
        walls and the world. ``Sensing`` replaces names by indices.
      points: parts of each body's surface feel on their own: a contact belongs to the nearest of these points, in the
        body's frame [m], shape (num_points, 3), or (num_bodies, num_points, 3) for points of each body. None: a body
        feels as a whole. ``octants`` gives eight.
      torque: whether torques are observed beside forces (static).
      frame: axes of forces and torques: ``"world"``, or ``"body"`` for those of the body at the step's end (static).
      gradient: whether the gradient flows from the observation into the physics (static).

    Torques are about the origin of the body's frame; the mean of a body that turns uses its pose in each substep.

    Gradient: exact; none by which point is nearest. ``gradient=False`` cuts it in ``see``.
    """

    bodies: tuple[int | str, ...] | None = struct.static_field(default=None)
    points: Vector | None = struct.number(FINITE, "give points in metres", default=None)
    torque: bool = struct.static_field(default=True)
    frame: str = struct.static_field(default="world")
    gradient: bool = struct.static_field(default=True)

    def __post_init__(self) -> None:
        if self.frame not in _FRAMES:
            raise ValueError(f'frame is {self.frame!r}: give "world" or "body"')
        for name in ("torque", "gradient"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} is {getattr(self, name)!r}: give True or False")
        if isinstance(self.bodies, (str, int, np.integer)):
            object.__setattr__(self, "bodies", (self.bodies,))
        if self.bodies is not None:
            object.__setattr__(self, "bodies", tuple(int(b) if isinstance(b, np.integer) else b for b in self.bodies))
        if self.bodies is not None and (not self.bodies or len(set(self.bodies)) < len(self.bodies)):
            raise ValueError(f"bodies is {self.bodies!r}: give each body once, or None for all that can touch")
        check_numbers(numbers_of(self, "Touch."))
        if self.points is not None:
            shape = jnp.shape(self.points)
            if len(shape) not in (2, 3) or shape[-1] != 3 or 0 in shape:
                raise ValueError(f"points has shape {shape}: give (num_points, 3), or (num_bodies, num_points, 3)")

    def on(self, task: Any) -> "Touch":
        """This sensor with indices of the task's bodies.

        Raises:
          ValueError: the task feels no contact, or has no such body.
        """
        known = getattr(task, "feeling_bodies", None)
        if known is None or not hasattr(task, "touch"):
            raise ValueError(
                f"{type(task).__name__} feels no contact: give a RigidTask, a SoftTask or a CoupledTask, or no Touch"
            )
        chosen = [name for name in known if name not in ("walls", "world")] if self.bodies is None else self.bodies
        if not chosen:
            raise ValueError(f"no body of {type(task).__name__} can touch anything: give bodies of {sorted(known)}")
        for name in chosen:
            if name not in known and name not in known.values():
                raise ValueError(
                    f"bodies has {name!r}, but {type(task).__name__} can feel {sorted(known)}: choose some"
                )
        found = self.replace(bodies=tuple(known.get(name, name) for name in chosen))  # type: ignore[arg-type]
        if self.points is not None and jnp.ndim(self.points) == 3 and len(self.points) != len(chosen):
            raise ValueError(
                f"points has shape {jnp.shape(self.points)}, but there are {len(chosen)} bodies: give (num_points, 3), "
                "or points of each body"
            )
        return found

    @property
    def patches(self) -> Patches:
        """Where it feels, for ``task.replace(touch={name: ...})``: all points of the first body, then of the next."""
        bodies = self._indices
        if self.points is None:
            return Patches(body=bodies)
        num, shape = len(bodies), jnp.shape(self.points)[-2:]
        center = jnp.broadcast_to(self.points, (num, *shape)).reshape(-1, 3)
        return Patches(body=tuple(int(b) for b in np.repeat(bodies, shape[0])), center=center)

    def measure(self, world: World) -> Wrench:
        """Force [N] and torque [N m] on each patch in the sensor's frame, shape (num_patches, 3) each. Gradient: exact.

        Raises:
          ValueError: nothing was felt: ``world`` is not that of a ``Sensing`` with this sensor.
        """
        if world.felt is None:
            raise ValueError("the world has nothing felt: put Touch into the sensors of a Sensing")
        if self.frame == "world":
            return world.felt
        owner, upright = np.asarray(self.patches.body), jnp.eye(3, dtype=world.felt.force.dtype)[None]
        turns = upright if world.bodies is None else jnp.concatenate([world.bodies.rotation, upright])
        rotation = jnp.swapaxes(turns[np.where(owner == WALLS, len(turns) - 1, owner)], -1, -2)  # walls do not turn
        return Wrench(*(turned(rotation, vector) for vector in world.felt))

    def see(self, world: World, key: Key) -> Array:
        """Forces of all patches, then their torques, shape (6 * num_patches,); (3 * num_patches,) without torques.

        Gradient: exact; cut with ``gradient=False``.
        """
        del key
        force, torque = self.measure(world)
        seen = jnp.concatenate([force.reshape(-1), torque.reshape(-1)]) if self.torque else force.reshape(-1)
        return seen if self.gradient else jax.lax.stop_gradient(seen)

    @property
    def _indices(self) -> tuple[int, ...]:
        bodies = self.bodies or ()
        if not bodies or not all(isinstance(body, int) for body in bodies):
            raise ValueError(f"bodies is {self.bodies!r}: give indices, or use Touch.on(task), as Sensing does")
        return bodies  # pyright: ignore[reportReturnType]


def octants(center: Any = (0.0, 0.0, 0.0)) -> Array:
    """Points that divide a body into octants around ``center`` [m], shape (3,), a point of its frame.

    They lie 0.01 m from it along each axis, shape (8, 3). The last axis changes fastest: ---, --+, -+-, -++,
    +--, +-+, ++-, +++.
    """
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    return jnp.asarray(center) + 0.01 * jnp.asarray(signs)


def touch_everywhere(task: Any) -> Touch:
    """A sensor of the force and torque on each body of a task that can touch something, without walls and the world.

    Raises:
      ValueError: the task feels no contact, or nothing in it can touch.
    """
    return Touch().on(task)


__all__ = ["Touch", "octants", "touch_everywhere"]
