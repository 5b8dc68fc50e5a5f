"""Particles in contact with bodies: nodes of the grid are what touches.

Colliders change the momentum of nodes; what they take is what their bodies receive. The velocity that nodes are given
is that which the body will have. It is predicted from all nodes that approach the body now. (Nodes that only the new
velocity runs into are not in it: a light body squeezed between heavy ones from two sides is the hard case.)
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import jax.numpy as jnp

from rewax.physics.contact.colliders import (
    MIN_INFLUENCE,
    Overlap,
    Touch,
    contact_velocity,
    friction_factor,
    nearest,
    shape_pose,
    touch,
)
from rewax.physics.contact.motion import Motion, placed, velocity_at
from rewax.physics.coupling.exchange import Received, System, add_contact, no_system
from rewax.physics.mpm.active_nodes import ActiveNodes
from rewax.physics.mpm.scene import MPMScene
from rewax.physics.mpm.step import Deformed, free_velocity, from_nodes, to_nodes, where_mass
from rewax.physics.mpm.walls import apply_walls
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.materialize import materialize
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.types import Array


class NodeContact(NamedTuple):
    """Nodes of the grid in the middle of a substep, see ``exchange.SoftContact``. Gradient: exact."""

    scene: MPMScene
    nodes: ActiveNodes
    particles: Deformed
    has_mass: Array
    mass: Array
    """Of each node [kg], 0 where nothing is, shape (num_nodes,)."""
    velocity: Vec3
    """Of each node [m/s]."""
    touches: tuple[Touch, ...] = ()
    """Of each collider."""

    def meet(self, poses: Pose, now: Sequence[Motion], before: Callable[[], Sequence[Motion]]) -> Self:
        del before
        position = self.nodes.position
        return self._replace(
            touches=tuple(
                touch(c, position, placed(shape_pose(c, body_pose(poses, c.body)), now[c.body]))
                for c in self.scene.sized_colliders
            )
        )

    def system(self, body: int, origin: Array) -> System:
        """It holds if nodes that approach now go on to, and friction acts as it would now.

        Of a node of mass m and influence w that slides, W = m w (s n n^T + (1 - s) 1), s what friction leaves of its
        tangential velocity: sticking nodes take their whole velocity from the body, sliding ones that along the normal.
        """
        alone = self.scene.overlap is Overlap.SEQUENTIAL or len(self.touches) < 2
        masses = [self.mass] * len(self.touches)
        if not alone:
            masses = [share * self.mass for share in nearest(list(self.touches))[1]]
        system = no_system(self.mass.dtype)
        arm = cp.vector(lambda i: self.nodes.position[i] - origin[i])
        for collider, t, mass in zip(self.scene.colliders, self.touches, masses, strict=True):
            if collider.body == body:
                system = _add_touch(system, arm, mass, self.velocity, t)
        return system

    def exchange(self, motions: Sequence[Motion | None], origins: Array) -> tuple[Self, Received]:
        touches, velocity, position = self._moving(motions), self.velocity, self.nodes.position
        received = Received(*[jnp.zeros_like(origins)] * 2)

        def lost(before: Vec3, after: Vec3, mass: Array) -> Vec3:
            return cp.vector(lambda i: mass * (before[i] - after[i]))

        if self.scene.overlap is Overlap.SEQUENTIAL or len(touches) < 2:
            for c, t in zip(self.scene.colliders, touches, strict=True):
                before, velocity = velocity, materialize(contact_velocity(t, velocity))
                received = received.and_from(position, lost(before, velocity, self.mass), c.body, origins)
            return self._replace(velocity=velocity), received
        best, shares = nearest(touches)
        after = materialize(contact_velocity(best, velocity))
        for c, share in zip(self.scene.colliders, shares, strict=True):
            received = received.and_from(position, lost(velocity, after, share * self.mass), c.body, origins)
        return self._replace(velocity=after), received

    def finish(self) -> Array:
        velocity = apply_walls(self.scene.walls, self.scene.grid, self.nodes.index, self.velocity)
        return from_nodes(self.scene, self.nodes, self.particles, where_mass((), (self.has_mass, velocity)))

    def _moving(self, motions: Sequence[Motion | None]) -> list[Touch]:
        """The touches with these motions of their bodies; None: as they were."""
        moved = [motions[collider.body] for collider in self.scene.colliders]
        return [
            t if motion is None else t._replace(velocity=velocity_at(motion, self.nodes.position))
            for motion, t in zip(moved, self.touches, strict=True)
        ]


def begin(scene: MPMScene, nodes: ActiveNodes, packed: Array) -> NodeContact:
    """First half of a substep: gravity and the particles' own stress act on the nodes. Gradient: exact."""
    particles, fields = to_nodes(scene, nodes, packed)
    has_mass, velocity = free_velocity(scene, fields)
    mass = jnp.where(has_mass, fields.mass, 0.0)
    return NodeContact(scene, nodes, particles, has_mass, mass, velocity)


def _add_touch(system: System, arm: Vec3, mass: Array, velocity: Vec3, t: Touch) -> System:
    relative = cp.subtract(velocity, t.velocity)
    approach = jnp.minimum(cp.dot(relative, t.normal), 0.0)
    tangential = cp.vector(lambda i: relative[i] - approach * t.normal[i])
    sliding = friction_factor(tangential, approach, t.friction)
    after = contact_velocity(t, velocity)
    weight = jnp.where((approach < 0) & (t.influence > MIN_INFLUENCE), mass * t.influence, 0.0)
    lost = cp.vector(lambda i: mass * (velocity[i] - after[i]))
    return add_contact(system, arm, t.normal, weight * sliding, weight * (1.0 - sliding), lost)


__all__ = ["NodeContact", "begin"]
