"""Forces of grasps on vertices, and how their holds follow them; the law is that of ``grasps``."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np

from rewax.lowering.kernels import pointwise
from rewax.physics.numerics import components as cp
from rewax.physics.numerics import divided_differences as dd
from rewax.physics.numerics.clipping import clipped
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.thin.grasps import Grasp, Hold
from rewax.physics.thin.stencils import Stencil, corners, scatter, sum_corners
from rewax.types import Array, Scalar

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


class HoldParts(NamedTuple):
    """``Hold`` by components, for the inner loop."""

    point: Vec3
    share: Array


class Pull(NamedTuple):
    """Force of a grasp in a substep, arrays over all vertices of the scene."""

    force: Vec3
    """Force on the vertices [N]."""
    rate: Array
    """Derivative of the force by the velocity of the body's point, over the substep [N s/m]."""


# --- State ------------------------------------------------------------------------------------------------------------


def open_holds(scene: "ThinScene", x: Array, poses: Pose) -> tuple[Hold, ...]:
    """The holds of grasps that have been open for a long time. Gradient: exact."""
    found = []
    for grasp in scene.grasps:
        at, body = _own(grasp, cp.split_vector(x)), body_pose(poses, grasp.body)
        point = _in_body(at, body)
        found.append(Hold(point=cp.join_vector(point), share=_reached(grasp, point)))
    return tuple(found)


def split_holds(holds: tuple[Hold, ...]) -> tuple[HoldParts, ...]:
    """Components of holds."""
    return tuple(HoldParts(cp.split_vector(hold.point), hold.share) for hold in holds)


def join_holds(holds: tuple[HoldParts, ...]) -> tuple[Hold, ...]:
    """Inverse of ``split_holds``."""
    return tuple(Hold(point=cp.join_vector(hold.point), share=hold.share) for hold in holds)


# --- Forces -----------------------------------------------------------------------------------------------------------


def followed(
    scene: "ThinScene", holds: tuple[HoldParts, ...], x: Vec3, poses: Pose, grips: Array
) -> tuple[HoldParts, ...]:
    """The holds a substep later, for grips of shape (num_grasps,) and poses at the substep's beginning.

    Gradient: exact.
    """
    found = []
    for i, (grasp, hold) in enumerate(zip(scene.grasps, holds, strict=True)):
        shared = (_numbers(grasp), scene.dt, body_pose(poses, grasp.body), clipped(grips[i], 0.0, 1.0))
        found.append(_followed(shared, (hold, _own(grasp, x))))
    return tuple(found)


def pulls(
    scene: "ThinScene",
    holds: tuple[HoldParts, ...],
    x: Vec3,
    v: Vec3,
    poses: Pose,
    surface: Sequence[Vec3],
    grips: Array,
) -> list[Pull]:
    """Forces of each grasp on the vertices.

    Args:
      scene: the scene.
      holds: the holds in this substep.
      x, v: positions [m] and velocities [m/s].
      poses: poses of all bodies at the substep's beginning.
      surface: velocity of each grasp's body at the vertices [m/s]: one vector by components, (num_vertices,), a grasp.
      grips: shape (num_grasps,).

    Gradient: exact.
    """
    found = []
    for i, (grasp, hold, moving) in enumerate(zip(scene.grasps, holds, surface, strict=True)):
        shared = (_numbers(grasp), scene.dt, body_pose(poses, grasp.body), clipped(grips[i], 0.0, 1.0))
        pull = _pull(shared, (hold, _own(grasp, x), _own(grasp, v), _own(grasp, moving)))
        if grasp.vertices is not None:
            at = _stencil(grasp, x[0].shape[-1])
            pull = Pull(scatter(at, (pull.force,)), sum_corners(at, (pull.rate,)))
        found.append(pull)
    return found


def body_velocities(scene: "ThinScene", x: Vec3, poses: tuple[Pose, Pose]) -> list[Vec3]:
    """Velocity [m/s] at the vertices of each grasp's body, which moves from one pose to the other in a substep.

    Gradient: exact.
    """
    found = []
    for grasp in scene.grasps:
        before, after = (body_pose(pose, grasp.body) for pose in poses)
        # Difference poses first: a resting body's velocity is exactly 0.
        turn = cp.split_matrix((after.rotation - before.rotation) / scene.dt)
        shift = (after.position - before.position) / scene.dt
        turned_by = cp.matvec(turn, _in_body(x, before))
        found.append(cp.vector(lambda i, u=turned_by, s=shift: u[i] + s[i]))
    return found


@pointwise
def _followed(shared: tuple[Grasp, Scalar, Pose, Array], vertices: tuple[HoldParts, Vec3]) -> HoldParts:
    (grasp, dt, body, grip), (hold, x) = shared, vertices
    left = 1.0 - grip
    follows = -dd.exp_minus_one(-dt * left * left * left * left / grasp.slip_time)
    now = _in_body(x, body)
    point = cp.vector(lambda i: hold.point[i] + follows * (now[i] - hold.point[i]))
    return HoldParts(point, hold.share + follows * (_reached(grasp, now) - hold.share))


@pointwise
def _pull(shared: tuple[Grasp, Scalar, Pose, Array], vertices: tuple[HoldParts, Vec3, Vec3, Vec3]) -> Pull:
    (grasp, dt, body, grip), (hold, x, v, surface) = shared, vertices
    turned_point = cp.matvec(cp.split_matrix(body.rotation), hold.point)
    firm = grip * hold.share

    def component(i: int) -> Array:
        spring = grasp.stiffness * (body.position[i] + turned_point[i] - x[i])
        return firm * (spring + grasp.damping * (surface[i] - v[i]))

    return Pull(cp.vector(component), firm * (dt * grasp.stiffness + grasp.damping))


def _reached(grasp: Grasp, point: Vec3) -> Array:
    """Share of the vertices that lie within reach, at points of the body's frame [m]."""
    if grasp.radius is None:
        return jnp.ones_like(point[0])
    distance = cp.norm(cp.vector(lambda i: point[i] - grasp.offset[i]))
    near = jnp.clip(2.0 - 2.0 * distance / grasp.radius, 0.0, 1.0)
    return near * near * (3.0 - 2.0 * near)


def _in_body(x: Vec3, body: Pose) -> Vec3:
    rotation = cp.split_matrix(body.rotation)
    return cp.matvec(cp.transpose(rotation), cp.vector(lambda i: x[i] - body.position[i]))


def _numbers(grasp: Grasp) -> Grasp:
    """The grasp without what belongs to the program, so that equal programs are shared."""
    return grasp.replace(body=0, vertices=None)


def _own(grasp: Grasp, a: Vec3) -> Vec3:
    """The vectors at the vertices that a grasp may hold."""
    return a if grasp.vertices is None else corners(_stencil(grasp, a[0].shape[-1]), a)[0]


def _stencil(grasp: Grasp, num_vertices: int) -> Stencil:
    return Stencil(np.asarray(grasp.vertices, int)[:, None], num_vertices)


__all__ = [
    "HoldParts", "Pull", "body_velocities", "followed", "join_holds", "open_holds", "pulls", "split_holds",
]  # fmt: skip
