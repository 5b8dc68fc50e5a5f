"""Tetrahedra with the forces that bodies feel: ``step``, and the penalty forces of the vertices on colliders."""

from typing import Any, NamedTuple

import jax

from rewax.lowering.fusion import materialize
from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import check_bodies
from rewax.physics.contact.patches import accumulated, check_patches, felt, no_touch
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.fields import checked, poses
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.substeps import both_ends, scan_substeps
from rewax.physics.tets.scene import SCENE, STATE, TetScene, TetState
from rewax.physics.tets.stepping import (
    Rest,
    Vertices,
    each_contact_force,
    join,
    moved,
    rest,
    split,
    total_force,
    vertex_forces,
)


@checked(scene=SCENE, state=STATE, poses=poses("num_substeps + 1", "num_bodies"))
def step_with_touch(
    scene: TetScene, state: TetState, poses: Pose, patches: Any, *, store_every: int | None = 1
) -> tuple[TetState, Any]:
    """``step``, and the mean force and torque of the vertices on patches of bodies.

    Args:
      scene, state, poses, store_every: as for ``step``.
      patches: ``contact.Patches``, or a dict of them; the ground is ``contact.WALLS``.

    Returns:
      The vertices of ``step``. Force [N] and torque [N m] on each patch, see ``mpm.step_with_touch``.

    Gradient: exact, as for ``step``. None by which patch a vertex is nearest to.

    Raises:
      ValueError: a patch belongs to a body that has no pose.
    """
    num_substeps, num_bodies = poses.position.shape[0] - 1, poses.position.shape[1]
    check_bodies(scene.colliders, num_bodies)
    check_patches(patches, num_bodies)
    constants = rest(scene)
    one = _substep if store_every is None else _recomputed_substep

    def body(carry: _Carry, interval: tuple[Pose, Pose]) -> _Carry:
        return one(scene, patches, constants, carry, interval)

    start = _Carry(split(state), no_touch(patches, state.x))
    end = scan_substeps(body, start, both_ends(poses), store_every)
    return join(end.vertices), jax.tree.map(lambda a: a / num_substeps, end.received)


class _Carry(NamedTuple):
    vertices: Vertices
    received: Any
    """Sums over substeps of the force and torque on each patch."""


def _substep(scene: TetScene, patches: Any, rest: Rest, carry: _Carry, interval: tuple[Pose, Pose]) -> _Carry:
    vertices = materialize(carry.vertices)
    x, v = vertices
    with jax.named_scope("tets"):
        force = vertex_forces(scene, rest, x, v)
    with jax.named_scope("contact"):
        each = each_contact_force(scene, x, v, interval)
        contact = total_force([given for _, given in each], x)
    with jax.named_scope("touch"):
        received = felt(patches, x, [(body, cp.scale(-1.0, given)) for body, given in each], interval[0])
    return _Carry(moved(scene, rest, vertices, force, contact), accumulated(carry.received, received))


_recomputed_substep = recomputed(_substep)

__all__ = ["step_with_touch"]
