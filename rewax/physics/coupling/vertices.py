"""Contact of vertices with bodies: penalty forces, implicit in the body's velocity.

The vertices are those of tetrahedra (``begin``) or of cloth and ropes (``sheets.begin``).

A spring of stiffness k against a body of mass M is stiff where k dt^2 > M, even if the vertices are slow. So the force
on a vertex is ``contact.penalty_force`` at the substep's beginning plus its change with the velocity of the body's
surface within the substep. With s the surface velocity before and s' after contact:

    f = f(x, v - s) + W (s' - s),    W = (dt k + damping) n n^T + drag (1 - n n^T).

Damping and drag are those at the beginning. f is linear in the body's velocity, so ``exchange.System`` is exact. The
body receives -f. At rest f is the penalty force. Springs that the body's own forces close within the substep act too;
otherwise a light body pressed on a surface would hop.

Vertices remain explicit. For any masses of the bodies, springs are stable at a substep at which they are stable against
a fixed body. Eliminating s' leaves springs of stiffness S = (1/k + dt^2 J M^-1 J^T)^-1. Let x displace the vertices and
X the bodies, and let C x - J X be the compression of the springs. The energy stored in S is at most that in k with
X = 0, plus X^T M X / (2 dt^2): S is two springs in series, which minimize their energy over the point between them.
Symplectic Euler is stable up to 4 x^T m x / (2 dt^2) of the first and 4 X^T M X / (2 dt^2) of the second.

Springs may still act on a separating body during the substep in which it leaves.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.motion import Motion
from rewax.physics.contact.patches import WALLS
from rewax.physics.contact.penalty import PenaltyContact, ground_force, penalty_response, surface
from rewax.physics.coupling.exchange import Received, System, add_contact, no_system
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.tets.scene import TetScene
from rewax.physics.tets.stepping import Rest, Vertices, moved, total_force, vertex_forces
from rewax.physics.thin.scene import ThinScene
from rewax.types import Array


class VertexTouch(NamedTuple):
    """Values of a collider at all vertices, arrays of shape (num_vertices,)."""

    force: Vec3
    """Force on the vertices for the body's velocity before the substep [N]."""
    normal: Vec3
    """Unit vector pointing away from the collider."""
    along: Array
    """Derivative of the normal force by the surface's normal velocity [N s/m]."""
    across: Array
    """Derivative of the tangential force by the surface's tangential velocity [N s/m]."""
    surface: Vec3
    """Velocity of the body's surface before the substep [m/s]."""
    pushed: Vec3
    """Change of the surface's velocity by the body's own forces [m/s]."""

    def force_at(self, change: Vec3) -> Vec3:
        """Force on the vertices [N] after a change of the surface's velocity [m/s]."""
        onto = (self.along - self.across) * cp.dot(self.normal, change)
        return cp.vector(lambda i: self.force[i] + self.across * change[i] + onto * self.normal[i])


class BodyTouch(NamedTuple):
    """Contact of one body with the vertices."""

    body: int
    touch: VertexTouch


class VertexContact(NamedTuple):
    """Vertices in the middle of a substep, see ``exchange.SoftContact``. Gradient: exact."""

    scene: TetScene | ThinScene
    x: Vec3
    """Positions [m]."""
    v: Vec3
    """Velocities [m/s]."""
    contact: Vec3
    """Contact forces on the vertices that depend on no body [N]; ``exchange`` adds those of bodies."""
    advance: Callable[[Vec3, Any], Any]
    """``(contact, holds) -> soft``: the rest of the substep, given all contact forces [N]."""
    holds: Any = ()
    """State of grasps."""
    more_touches: Callable[[Any, Pose, Sequence[Motion], Sequence[Motion]], tuple[Any, list[BodyTouch]]] | None = None
    """``(holds, poses, now, before) -> holds, touches``: forces of bodies beside those of colliders."""
    touches: tuple[BodyTouch, ...] = ()
    """Values of each collider at the vertices, then those of ``more_touches``."""
    forces: tuple[Vec3, ...] = ()
    """Forces of each touch on the vertices [N]."""

    def meet(self, poses: Pose, now: Sequence[Motion], before: Callable[[], Sequence[Motion]]) -> Self:
        scene, were = self.scene, before()
        assert scene.contact is not None or not scene.colliders

        def one(c: Collider) -> BodyTouch:
            pose, motions = body_pose(poses, c.body), (now[c.body], were[c.body])
            return BodyTouch(c.body, _touch(c, scene.contact, scene.dt, self.x, self.v, pose, *motions))  # pyright: ignore[reportArgumentType]

        holds, more = self.holds, []
        if self.more_touches is not None:
            holds, more = self.more_touches(holds, poses, now, were)
        return self._replace(touches=(*(one(c) for c in scene.colliders), *more), holds=holds)

    def system(self, body: int, origin: Array) -> System:
        x, dt = self.x, self.scene.dt
        system = no_system(x[0].dtype)
        arm = cp.vector(lambda i: x[i] - origin[i])
        for owner, t in self.touches:
            if owner == body:
                lost = cp.scale(-dt, t.force_at(t.pushed))
                system = add_contact(system, arm, t.normal, dt * (t.along - t.across), dt * t.across, lost)
        return system

    def exchange(self, motions: Sequence[Motion | None], origins: Array) -> tuple[Self, Received]:
        x, total = self.x, self.contact
        received, forces = Received(*[jnp.zeros_like(origins)] * 2), []
        for body, t in self.touches:
            motion = motions[body]
            change = t.pushed if motion is None else cp.subtract(velocity_of(motion, x), t.surface)
            force = materialize(t.force_at(change))
            received = received.and_from(x, cp.scale(-self.scene.dt, force), body, origins)
            total = cp.add(total, force)
            forces.append(force)
        return self._replace(contact=total, forces=tuple(forces)), received

    def finish(self) -> Any:
        return self.advance(self.contact, self.holds)

    def given(self) -> tuple[Vec3, list[tuple[int, Vec3]]]:
        every = [(touch.body, force) for touch, force in zip(self.touches, self.forces, strict=True)]
        every += ground_forces(self.scene, self.x, self.v)
        return self.x, [(body, cp.scale(-self.scene.dt, force)) for body, force in every]


def begin(scene: TetScene, rest: Rest, vertices: Vertices) -> VertexContact:
    """First part of a substep of tetrahedra: their own forces and those of the ground. Gradient: exact."""
    vertices = materialize(vertices)
    x, v = vertices
    internal, ground = vertex_forces(scene, rest, x, v), total_force([f for _, f in ground_forces(scene, x, v)], x)

    def advance(contact: Vec3, holds: Any) -> Vertices:
        del holds
        return moved(scene, rest, vertices, internal, contact)

    return VertexContact(scene, x, v, ground, advance)


def ground_forces(scene: TetScene | ThinScene, x: Vec3, v: Vec3) -> list[tuple[int, Vec3]]:
    """The body ``WALLS`` and the forces of the ground on the vertices [N]; empty without ground. Gradient: exact."""
    if scene.contact is None or scene.ground is None:
        return []
    return [(WALLS, ground_force(scene.ground, scene.contact, x, v))]


def _touch(
    collider: Collider, law: PenaltyContact, dt: float, x: Vec3, v: Vec3, body: Pose, now: Motion, before: Motion
) -> VertexTouch:
    distance, normal, _ = surface(collider, x, body)
    was = velocity_of(before, x)
    response = penalty_response(law, distance, normal, cp.subtract(v, was), collider.friction)
    pushed = cp.subtract(velocity_of(now, x), was)
    touches = response.gap < 0
    reached = ~touches & (response.gap < dt * cp.dot(normal, pushed))
    damping = jnp.where(touches & (response.separating < 0), response.damping, 0.0)
    along = jnp.where(touches | reached, dt * law.stiffness, 0.0) + damping
    push = jnp.where(reached, -law.stiffness * response.gap, response.push)
    force = cp.vector(lambda i: push * normal[i] - response.drag * response.sliding[i])
    return materialize(VertexTouch(force, normal, along, response.drag, was, pushed))


def velocity_of(motion: Motion, x: Vec3) -> Vec3:
    """Velocity of a body's points [m/s]. Gradient: exact, also with respect to the positions."""
    turned = cp.matvec(cp.split_matrix(motion.turn), x)
    return cp.vector(lambda i: turned[i] + motion.shift[i])


__all__ = ["BodyTouch", "VertexContact", "VertexTouch", "begin", "ground_forces", "velocity_of"]
