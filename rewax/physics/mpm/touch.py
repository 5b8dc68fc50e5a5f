"""The material point method with the forces that bodies feel: ``step``, and the momentum that nodes lose to colliders.

A collider changes the velocity of nodes. Their mass times this change is the impulse on the collider's body.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import check_bodies, place
from rewax.physics.contact.feeling import Feeling, scan_touch
from rewax.physics.contact.losses import velocity_losses
from rewax.physics.contact.motion import Placed
from rewax.physics.contact.patches import WALLS, feels_walls, felt
from rewax.physics.mpm.active_nodes import ActiveNodes
from rewax.physics.mpm.packing import join, split
from rewax.physics.mpm.scene import SCENE, STATE, MPMScene, MPMState, check_state
from rewax.physics.mpm.stepping import colliders_at, free_velocity, from_nodes, nodes_of_step, to_nodes, where_mass
from rewax.physics.mpm.transfer import GridFields
from rewax.physics.mpm.walls import apply_walls
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import check_precision
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.fields import checked, poses
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.substeps import both_ends
from rewax.types import Array


@checked(scene=SCENE, state=STATE, poses=poses("num_substeps + 1", "num_bodies"))
def step_with_touch(
    scene: MPMScene, state: MPMState, poses: Pose, patches: Any, *, store_every: int | None = 1
) -> tuple[MPMState, Any]:
    """``step``, and the mean force and torque of the particles on patches of bodies.

    Args:
      scene, state, poses, store_every: as for ``step``.
      patches: ``contact.Patches``, or a dict of them.

    Returns:
      The particles of ``step``. Force [N] and torque [N m] on each patch, a ``Wrench`` of arrays (num_patches, 3) for
      each ``Patches``: world axes, torque about the origin of the body's frame, averaged over the step.

    Gradient: exact, as for ``step``. None by which patch a node is nearest to.

    Raises:
      ValueError: a patch belongs to a body that has no pose.
    """
    check_state(scene, state)
    check_bodies(scene.colliders, poses.position.shape[1])
    check_precision(state.x, scene.gravity, poses.position)
    nodes = nodes_of_step(scene, state.x)
    one = _substep if store_every is None else _recomputed_substep
    before, after = both_ends(poses)
    intervals = place(scene.colliders, before, after, scene.dt), before

    def substep(carry: Feeling[Array], interval: tuple[Placed, Pose]) -> Feeling[Array]:
        return one(scene, patches, nodes, carry, interval)

    particles, touch = scan_touch(
        substep, split(state), intervals, poses, patches, store_every=store_every, dt=scene.dt
    )
    return join(particles), touch


class _Owned(NamedTuple):
    """``Placed``, and the body of each shape."""

    pose: Pose
    matrix: Array
    offset: Array
    body: Array


def _substep(
    scene: MPMScene, patches: Any, nodes: ActiveNodes, carry: Feeling[Array], interval: tuple[Placed, Pose]
) -> Feeling[Array]:
    placed, bodies = interval
    particles, fields = to_nodes(scene, nodes, carry.soft)
    with jax.named_scope("grid"):
        velocity, received = _grid_velocity(scene, nodes, fields, placed, walls=feels_walls(patches))
    with jax.named_scope("touch"):
        impulse = felt(patches, nodes.position, received, bodies)
    return carry.after(from_nodes(scene, nodes, particles, velocity), impulse)


_recomputed_substep = recomputed(_substep)


def _grid_velocity(
    scene: MPMScene, nodes: ActiveNodes, fields: GridFields, placed: Placed, *, walls: bool
) -> tuple[Vec3, list[tuple[int | Array, Vec3]]]:
    """``stepping.grid_velocity``, and the momentum that each body receives from each node [kg m/s]."""
    has_mass, velocity = free_velocity(scene, fields)
    mass = jnp.where(has_mass, fields.mass, 0.0)
    owner = jnp.asarray([c.body for c in scene.colliders], jnp.int32)
    near = colliders_at(scene, nodes, has_mass, _Owned(*placed, owner))  # pyright: ignore[reportArgumentType]
    every = len(near) == len(scene.colliders)  # else the broad phase chose some
    placed_near: list[Any] = [p for _, p in near]
    owners = [c.body if every else given.body for c, given in zip(scene.colliders, placed_near, strict=False)]
    colliders = [(collider, Placed(*given[:3])) for collider, given in near]
    velocity, lost = velocity_losses(colliders, nodes.position, velocity, overlap=scene.overlap)
    received = [(body, cp.scale(mass, change)) for body, change in zip(owners, lost, strict=True)]
    after = apply_walls(scene.walls, scene.grid, nodes.index, velocity)
    if walls:
        received.append((WALLS, cp.scale(mass, cp.subtract(velocity, after))))
    return where_mass(has_mass, after), received


__all__ = ["step_with_touch"]
