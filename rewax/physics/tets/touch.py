"""Tetrahedra with the forces that bodies feel: ``step``, and the penalty forces of the vertices on colliders."""

from typing import Any

import jax

from rewax.lowering.fusion import materialize
from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import check_bodies
from rewax.physics.contact.feeling import Feeling, scan_touch
from rewax.physics.contact.patches import felt
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import check_precision
from rewax.physics.numerics.fields import checked, poses
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.substeps import both_ends
from rewax.physics.tets.scene import SCENE, STATE, TetScene, TetState, check_vertices
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
    check_vertices(scene, state)
    check_bodies(scene.colliders, poses.position.shape[1])
    check_precision(state.x, scene.gravity, poses.position)
    constants = rest(scene)
    one = _substep if store_every is None else _recomputed_substep

    def substep(carry: Feeling[Vertices], interval: tuple[Pose, Pose]) -> Feeling[Vertices]:
        return one(scene, patches, constants, carry, interval)

    vertices, touch = scan_touch(substep, split(state), both_ends(poses), poses, patches, store_every=store_every)
    return join(vertices), touch


def _substep(
    scene: TetScene, patches: Any, rest: Rest, carry: Feeling[Vertices], interval: tuple[Pose, Pose]
) -> Feeling[Vertices]:
    vertices = materialize(carry.soft)
    x, v = vertices
    with jax.named_scope("tets"):
        force = vertex_forces(scene, rest, x, v)
    with jax.named_scope("contact"):
        each = each_contact_force(scene, x, v, interval)
        contact = total_force([given for _, given in each], x)
    with jax.named_scope("touch"):
        received = felt(patches, x, [(body, cp.scale(-1.0, given)) for body, given in each], interval[0])
    return carry.after(moved(scene, rest, vertices, force, contact), received)


_recomputed_substep = recomputed(_substep)

__all__ = ["step_with_touch"]
