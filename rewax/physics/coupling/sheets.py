"""Contact of cloth and ropes with bodies, through their vertices: penalty contact, and grasps.

A grasp is one more spring between vertices and a body: ``vertices.VertexTouch`` without a normal.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.physics.contact.motion import Motion
from rewax.physics.coupling.vertices import BodyTouch, VertexContact, VertexTouch, ground_forces, velocity_of
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin import grasp_forces
from rewax.physics.thin.prescribed import NOTHING_PRESCRIBED, Prescribed
from rewax.physics.thin.scene import ThinScene
from rewax.physics.thin.self_contact import AllPairs, self_forces
from rewax.physics.thin.stepping import Vertices, moved, vertex_forces


def begin(
    scene: ThinScene,
    pairs: AllPairs | None,
    vertices: Vertices,
    prescribed: Prescribed = NOTHING_PRESCRIBED,
    extra: Vec3 | None = None,
) -> VertexContact:
    """First part of a substep: the forces of cloth and ropes, ground and self-contact.

    Args:
      scene: the scene.
      pairs: close pairs of self-contact; None: none.
      vertices: the vertices.
      prescribed: pins and grips of the substep.
      extra: further forces on the vertices [N].

    Gradient: exact.
    """
    vertices = materialize(vertices)
    x, v, holds = vertices
    internal = vertex_forces(scene, x, v)
    contact = cp.vector(lambda i: jnp.zeros_like(x[i])) if extra is None else extra
    for _, force in ground_forces(scene, x, v):
        contact = cp.add(contact, force)
    if pairs is not None:
        contact = cp.add(contact, self_forces(scene, x, v, pairs))

    def advance(contact: Vec3, holds: Any) -> Vertices:
        return moved(scene, Vertices(x, v, holds), internal, contact, prescribed.pins)

    def more(holds: Any, poses: Pose, now: Sequence[Motion], before: Sequence[Motion]) -> tuple[Any, list[BodyTouch]]:
        return _grasped(scene, vertices._replace(holds=holds), prescribed, poses, now, before)

    return VertexContact(scene, x, v, contact, advance, holds, more if scene.grasps else None)


def _grasped(
    scene: ThinScene,
    vertices: Vertices,
    prescribed: Prescribed,
    poses: Pose,
    now: Sequence[Motion],
    before: Sequence[Motion],
) -> tuple[Any, list[BodyTouch]]:
    """The holds in this substep, and what each grasp does to the vertices."""
    x, v, holds = vertices
    assert prescribed.grips is not None
    holds = grasp_forces.followed(scene, holds, x, poses, prescribed.grips)
    surface = [velocity_of(before[grasp.body], x) for grasp in scene.grasps]
    pulls = grasp_forces.pulls(scene, holds, x, v, poses, surface, prescribed.grips)
    nothing = cp.vector(lambda i: jnp.zeros_like(x[i]))
    touches = []
    for grasp, pull, was in zip(scene.grasps, pulls, surface, strict=True):
        pushed = cp.subtract(velocity_of(now[grasp.body], x), was)
        touch = VertexTouch(pull.force, nothing, pull.rate, pull.rate, was, pushed)
        touches.append(BodyTouch(grasp.body, materialize(touch)))
    return holds, touches


__all__ = ["begin"]
