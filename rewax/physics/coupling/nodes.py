"""Contact of particles with bodies, through the nodes of the grid.

Colliders change the momentum of nodes, and their bodies receive the opposite change. Contact uses the body's velocity
after contact, predicted from all nodes that approach the body now. (The prediction ignores nodes that only the new
velocity approaches. A light body squeezed from two sides between heavy ones is the hard case.)
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import jax.numpy as jnp

from rewax.lowering.kernels import pointwise
from rewax.physics.contact.colliders import (
    MIN_INFLUENCE,
    Collider,
    Overlap,
    Touch,
    contact_velocity,
    friction_factor,
    nearest,
    shape_pose,
    touch,
)
from rewax.physics.contact.motion import Motion, Placed, placed, velocity_at
from rewax.physics.contact.patches import WALLS
from rewax.physics.coupling.exchange import Received, System, add_contact, add_contact_matrices, no_system
from rewax.physics.mpm.active_nodes import ActiveNodes
from rewax.physics.mpm.scene import MPMScene
from rewax.physics.mpm.stepping import Deformed, free_velocity, from_nodes, to_nodes, where_mass
from rewax.physics.mpm.walls import apply_walls
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Mat3, Vec3
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.types import Array, Scalar


class NodeContact(NamedTuple):
    """Nodes of the grid in the middle of a substep, see ``exchange.SoftContact``. Gradient: exact."""

    scene: MPMScene
    nodes: ActiveNodes
    particles: Deformed
    has_mass: Array
    mass: Array
    """Mass of each node [kg], 0 for empty nodes, shape (num_nodes,)."""
    velocity: Vec3
    """Velocity of each node [m/s]."""
    touches: tuple[Touch, ...] = ()
    """Values of each collider at the nodes."""
    lost: tuple[Vec3, ...] = ()
    """Momentum that the nodes lost to each collider [kg m/s]."""

    def meet(self, poses: Pose, now: Sequence[Motion], before: Callable[[], Sequence[Motion]]) -> Self:
        del before
        position = self.nodes.position
        return self._replace(
            touches=tuple(
                _touch(c, position, placed(shape_pose(c, body_pose(poses, c.body)), now[c.body]))
                for c in self.scene.sized_colliders
            )
        )

    def system(self, body: int, origin: Array) -> System:
        """Linearization that assumes the present set of approaching nodes and the present friction.

        A node of mass m and influence w has W = m w (s n n^T + (1 - s) 1). Here s is the share of its tangential
        velocity after friction. Sticking nodes (s = 0) take their whole velocity from the body, sliding ones the normal
        component.

        Under ``Overlap.SEQUENTIAL`` the colliders of one body act in turn: each changes the velocity that the earlier
        ones leave. If they leave P u of a velocity u relative to the body, then W = m (1 - P), and P is the product of
        all 1 - W / m of single colliders. The system takes the symmetric part of W. That is all of it where the normals
        are equal or perpendicular, and where nodes stick. Where nodes slide between normals at another angle, the
        body's velocity after contact differs from the predicted one. Momentum is conserved in any case.
        """
        in_turn = self.scene.overlap is Overlap.SEQUENTIAL
        system = no_system(self.mass.dtype)
        arm = cp.vector(lambda i: self.nodes.position[i] - origin[i])
        own = [t for c, t in zip(self.scene.colliders, self.touches, strict=True) if c.body == body]
        if in_turn and len(own) > 1:
            return add_contact_matrices(system, arm, *_several(own, self.velocity, self.mass))
        masses = [self.mass] * len(self.touches)
        if not in_turn and len(self.touches) > 1:
            masses = [share * self.mass for share in nearest(list(self.touches))[1]]
        for collider, t, mass in zip(self.scene.colliders, self.touches, masses, strict=True):
            if collider.body == body:
                system = _add_touch(system, arm, mass, self.velocity, t)
        return system

    def exchange(self, motions: Sequence[Motion | None], origins: Array) -> tuple[Self, Received]:
        touches, velocity, position = self._moving(motions), self.velocity, self.nodes.position
        received = Received(*[jnp.zeros_like(origins)] * 2)
        if self.scene.overlap is Overlap.SEQUENTIAL or len(touches) < 2:
            every = []
            for c, t in zip(self.scene.colliders, touches, strict=True):
                velocity, lost = _after(t.friction, (_without_friction(t), velocity, self.mass))
                received = received.and_from(position, lost, c.body, origins)
                every.append(lost)
            return self._replace(velocity=velocity, lost=tuple(every)), received
        best, shares = nearest(touches)
        after, lost = _after(None, (best, velocity, self.mass))
        every = [cp.vector(lambda i, share=share: share * lost[i]) for share in shares]
        for c, part in zip(self.scene.colliders, every, strict=True):
            received = received.and_from(position, part, c.body, origins)
        return self._replace(velocity=after, lost=tuple(every)), received

    def finish(self) -> Array:
        return from_nodes(self.scene, self.nodes, self.particles, where_mass(self.has_mass, self._inside_walls()))

    def given(self) -> tuple[Vec3, list[tuple[int, Vec3]]]:
        to_walls = cp.scale(self.mass, cp.subtract(self.velocity, self._inside_walls()))
        bodies = [collider.body for collider in self.scene.colliders]
        return self.nodes.position, [*zip(bodies, self.lost, strict=True), (WALLS, to_walls)]

    def _inside_walls(self) -> Vec3:
        return apply_walls(self.scene.walls, self.scene.grid, self.nodes.index, self.velocity)

    def _moving(self, motions: Sequence[Motion | None]) -> list[Touch]:
        """The touches with new motions of their bodies; None: unchanged."""
        moved = [motions[collider.body] for collider in self.scene.colliders]
        return [
            t if motion is None else t._replace(velocity=velocity_at(motion, self.nodes.position))
            for motion, t in zip(moved, self.touches, strict=True)
        ]


def begin(scene: MPMScene, nodes: ActiveNodes, packed: Array) -> NodeContact:
    """First half of a substep: gravity and the particles' stress act on the nodes. Gradient: exact."""
    particles, fields = to_nodes(scene, nodes, packed)
    has_mass, velocity = free_velocity(scene, fields)
    mass = jnp.where(has_mass, fields.mass, 0.0)
    return NodeContact(scene, nodes, particles, has_mass, mass, velocity)


def _touch(collider: Collider, position: Vec3, placed: Placed) -> Touch:
    distance, influence, normal, velocity = _met((collider.replace(body=0), placed), position)
    return Touch(distance, influence, normal, collider.friction, velocity)


@pointwise
def _met(moving: tuple[Collider, Placed], position: Vec3) -> tuple[Array, Array, Vec3, Vec3]:
    collider, placed = moving
    t = touch(collider, position, placed)
    return t.distance, t.influence, t.normal, t.velocity


def _without_friction(t: Touch) -> Touch:
    """The touch without friction, which may be one number instead of an array over nodes."""
    return t._replace(friction=None)  # type: ignore[arg-type]


def _with_friction(t: Touch, friction: Scalar | None) -> Touch:
    return t if friction is None else t._replace(friction=friction)


@pointwise
def _after(friction: Scalar | None, nodes: tuple[Touch, Vec3, Array]) -> tuple[Vec3, Vec3]:
    """Node velocities after contact, and the momentum that nodes lose."""
    t, velocity, mass = nodes
    after = contact_velocity(_with_friction(t, friction), velocity)
    return after, cp.vector(lambda i: mass * (velocity[i] - after[i]))


@pointwise
def _weights(friction: Scalar | None, nodes: tuple[Touch, Vec3, Array]) -> tuple[Array, Array]:
    """Effective masses along the normal, and in all directions."""
    t, velocity, mass = nodes
    t = _with_friction(t, friction)
    relative = cp.subtract(velocity, t.velocity)
    approach = jnp.minimum(cp.dot(relative, t.normal), 0.0)
    tangential = cp.vector(lambda i: relative[i] - approach * t.normal[i])
    sliding = friction_factor(tangential, approach, t.friction)
    weight = jnp.where((approach < 0) & (t.influence > MIN_INFLUENCE), mass * t.influence, 0.0)
    return weight * sliding, weight * (1.0 - sliding)


def _several(touches: list[Touch], velocity: Vec3, mass: Array) -> tuple[Mat3, Vec3]:
    """W of a body's colliders that act in turn [kg], and the momentum that it takes from the nodes [kg m/s]."""
    relative, one, zero = cp.subtract(velocity, touches[0].velocity), jnp.ones_like(mass), jnp.zeros_like(mass)
    left = cp.matrix(lambda i, j: one if i == j else zero)
    for t in touches:
        nodes = (_without_friction(t), velocity, one)
        left = _left(None, (left, t.normal, *_weights(t.friction, nodes)))
        velocity = _after(t.friction, nodes)[0]
    return _symmetric(None, (left, relative, mass))


@pointwise
def _left(_: None, nodes: tuple[Mat3, Vec3, Array, Array]) -> Mat3:
    """The matrix P after another collider."""
    left, normal, along, whole = nodes
    pushed = cp.vector(lambda j: along * (normal[0] * left[0][j] + normal[1] * left[1][j] + normal[2] * left[2][j]))
    return cp.matrix(lambda i, j: (1.0 - whole) * left[i][j] - normal[i] * pushed[j])


@pointwise
def _symmetric(_: None, nodes: tuple[Mat3, Vec3, Array]) -> tuple[Mat3, Vec3]:
    """The symmetric part of m (1 - P), and its product with the relative velocity."""
    left, relative, mass = nodes
    weights = cp.matrix(lambda i, j: mass * (float(i == j) - 0.5 * (left[i][j] + left[j][i])))
    return weights, cp.matvec(weights, relative)


def _add_touch(system: System, arm: Vec3, mass: Array, velocity: Vec3, t: Touch) -> System:
    nodes = (_without_friction(t), velocity, mass)
    return add_contact(system, arm, t.normal, *_weights(t.friction, nodes), _after(t.friction, nodes)[1])


__all__ = ["NodeContact", "begin"]
