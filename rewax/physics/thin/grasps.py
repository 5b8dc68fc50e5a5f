"""Grasps: vertices that a body holds while a number says so.

``Grasp`` has the force and its symbols. Points a and shares w follow the vertices while the grasp is open, and stay
while it is closed:

    da/dt = (1 - g)^4 / slip_time (R^T (x - p) - a),    dw/dt = (1 - g)^4 / slip_time (reached - w).

``reached`` is 1 up to half of the radius around the grasp's center and falls smoothly to 0 at the radius. So a grasp
holds what lies between its fingers when it closes, an open one exerts no force, and a half closed one lets the cloth
slip like a viscous fluid. Nothing jumps: the derivatives by grip, pose and vertices are exact. A grip of 0.9 keeps its
points for 10,000 slip times.
"""

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics.contact.vertex_checks import held_indices
from rewax.physics.numerics.checks import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    Number,
    check_numbers,
    numbers_of,
    static_integer,
)
from rewax.physics.numerics.fields import check_range, instance, items
from rewax.types import Array, Scalar, Vector

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


@struct.dataclass
class Grasp(struct.Replaceable):
    """A gripper on a body. ``step`` takes its grip g, 0 for open to 1 for closed, as one entry of ``grips``.

    A grasp ties each vertex x that it may hold to a point a of its body's frame, with a share w in [0, 1]. With the
    body's position p and rotation R, and the velocity s of the body's material point at x, the force on the vertex is

        f = g w (stiffness (p + R a - x) + damping (s - v)),

    and the body feels -f at x. Points and shares of an open grasp follow the vertices; those of a closed one stay.

    Attributes:
      radius: distance from the center up to which vertices are held [m]; None: all of ``vertices`` at any distance.
      stiffness: force per displacement at each held vertex [N/m]; ``largest_stable_dt`` includes it.
      damping: force per velocity at each held vertex [N s/m].
      slip_time: time in which an open grasp's points follow the vertices [s].
      offset: center of the grasp in the body's frame [m], shape (3,); by default zero.
      body: index of the body (static).
      vertices: indices of the vertices that the grasp may hold, or a mask over all (static); None: all.
      num_vertices: length of the mask that was given, which the scene's number of vertices must equal (static).
    """

    radius: Scalar | None = struct.number(POSITIVE, "give a length in metres", shape=(), default=None)
    stiffness: Scalar = struct.number(POSITIVE, "give a force per displacement in N/m", shape=())
    damping: Scalar = struct.number(NOT_NEGATIVE, "give a number of N s/m", shape=(), default=0.0)
    slip_time: Scalar = struct.number(POSITIVE, "give a time in seconds", shape=(), default=1e-3)
    offset: Vector = struct.number(
        FINITE, "give a position in metres", shape=(3,), default_factory=lambda: jnp.zeros(3)
    )
    body: int = struct.static_field(default=0)
    vertices: tuple[int, ...] | None = struct.static_field(default=None)
    num_vertices: int | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        static_integer("Grasp.body", self.body, 0, "give the index of a body, counted from 0")
        if self.vertices is not None:
            given = np.asarray(self.vertices)
            is_mask = given.dtype == bool
            held = held_indices(given, given.size if is_mask else np.iinfo(np.int32).max, "vertices")
            if len(held) == 0:
                raise ValueError("Grasp.vertices holds no vertex: give indices or a mask of some, or None for all")
            if is_mask:
                object.__setattr__(self, "num_vertices", given.size)
            object.__setattr__(self, "vertices", tuple(int(k) for k in held))


@struct.dataclass
class Hold(struct.Replaceable):
    """The part of the state that belongs to one grasp.

    Attributes:
      point: where the grasp holds its vertices, in the body's frame [m], shape (num, 3).
      share: how firmly [-], 0 to 1, shape (num,).
    """

    point: Array
    share: Array


GRASPS = items(instance(Grasp, "give a Grasp(radius=..., stiffness=...)"), "give a tuple of grasps, () for none")


def grasp_numbers(grasps: tuple[Grasp, ...]) -> list[Number]:
    """The numbers of grasps, with their legal values."""
    return [number for i, grasp in enumerate(grasps) for number in numbers_of(grasp, f"grasps[{i}].")]


def check_grasps(grasps: tuple[Grasp, ...], num_vertices: int) -> None:
    """Raises ValueError for illegal numbers, vertices that do not exist, and grasps without vertices or radius."""
    check_numbers(grasp_numbers(grasps))
    for i, grasp in enumerate(grasps):
        if grasp.num_vertices not in (None, num_vertices):
            raise ValueError(
                f"grasps[{i}].vertices is a mask of length {grasp.num_vertices}, but the scene has {num_vertices} "
                f"vertices: give a mask of length {num_vertices}, or indices"
            )
        if grasp.vertices is not None:
            check_range(f"grasps[{i}].vertices", np.asarray(grasp.vertices, int), num_vertices)
        elif grasp.radius is None:
            raise ValueError(f"grasps[{i}] has neither radius nor vertices: give a radius in metres, or vertices")


def checked_grips(scene: "ThinScene", holds: Any, grips: Any, num_substeps: int, num_bodies: int) -> Array | None:
    """Grips of every substep, shape (num_substeps, num_grasps); None for a scene without grasps.

    Raises:
      ValueError: grips of another shape, a state without holds, or a grasp of a body without a pose.
    """
    count = len(scene.grasps)
    shape = None if grips is None else np.shape(grips)
    if (grips is not None or count) and shape not in ((count,), (num_substeps, count)):
        raise ValueError(
            f"grips has shape {shape}, but the scene has {count} grasps and poses {num_substeps} substeps: give shape "
            f"({count},) for constant grips, ({num_substeps}, {count}), or None without grasps"
        )
    if len(holds) != count:
        raise ValueError(
            f"state.holds has {len(holds)} entries, but the scene has {count} grasps: begin with thin.open_grasps"
        )
    for i, (grasp, hold) in enumerate(zip(scene.grasps, holds, strict=True)):
        num = scene.topology.triangles.num_vertices if grasp.vertices is None else len(grasp.vertices)
        if jnp.shape(hold.point) != (num, 3) or jnp.shape(hold.share) != (num,):
            raise ValueError(
                f"state.holds[{i}] has points of shape {jnp.shape(hold.point)} and shares of shape "
                f"{jnp.shape(hold.share)}, but grasps[{i}] may hold {num} vertices: begin with thin.open_grasps"
            )
    check_grasp_bodies(scene.grasps, num_bodies)
    return None if not count else jnp.broadcast_to(jnp.asarray(grips, holds[0].share.dtype), (num_substeps, count))


def check_grasp_bodies(grasps: tuple[Grasp, ...], num_bodies: int) -> None:
    """Raises ValueError if the body of a grasp has no pose (JAX would clamp the index silently)."""
    for i, grasp in enumerate(grasps):
        if grasp.body >= num_bodies:
            raise ValueError(
                f"grasps[{i}] belongs to body {grasp.body}, but there are poses of {num_bodies} bodies: give poses to "
                "all bodies, or the grasp another body (they count from 0)"
            )


def grasp_stiffness(scene: "ThinScene") -> tuple[Array, Array]:
    """Largest stiffness [N/m] and damping [N s/m] of all closed grasps at each vertex, (num_vertices,).

    Gradient: exact.
    """
    stiffness = damping = jnp.zeros_like(scene.mass)
    for grasp in scene.grasps:
        at = slice(None) if grasp.vertices is None else np.asarray(grasp.vertices, int)
        stiffness, damping = stiffness.at[at].add(grasp.stiffness), damping.at[at].add(grasp.damping)
    return stiffness, damping


__all__ = [
    "GRASPS", "Grasp", "Hold", "check_grasp_bodies", "check_grasps", "checked_grips", "grasp_numbers",
    "grasp_stiffness",
]  # fmt: skip
