"""Particles and free rigid bodies that push each other.

Colliders change the momentum of nodes; what they take is what their bodies receive. So momentum is exchanged, never
made, and a box floats in water because the water holds it up. ``mpm.step`` is the one-way case, in which bodies move
as prescribed.

The contact of light bodies with heavy particles is stiff: a body that answered only after it took the particles'
momentum would be thrown back and forth. So the velocity that nodes are given is that which the body will have: one
linear system of six unknowns per body and substep, formed from all nodes it touches. (Nodes that only the new velocity
runs into are not in it: a light body squeezed between heavy ones from two sides is the hard case.)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.physics.contact.colliders import (
    MIN_INFLUENCE,
    Collider,
    Motion,
    Overlap,
    Touch,
    check_bodies,
    chord_motion,
    contact_velocity,
    friction_factor,
    nearest,
    shape_pose,
    touch,
    velocity_at,
)
from rewax.physics.coupling import free_body
from rewax.physics.coupling.free_body import FreeBodies, Inertia, inertia_numbers, solve3
from rewax.physics.mpm.active_nodes import ActiveNodes
from rewax.physics.mpm.scene import MPMScene, MPMState
from rewax.physics.mpm.step import Particles, free_velocity, from_nodes, join, nodes_of_step, split, to_nodes
from rewax.physics.mpm.walls import apply_walls
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import check_numbers
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.materialize import materialize
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.numerics.recompute import recomputed, scan_substeps
from rewax.physics.numerics.rotations import skew
from rewax.types import Array


class Wrench(NamedTuple):
    """Force [N] and torque about the body's origin [N m] on each body, shapes (num_bodies, 3)."""

    force: Array
    torque: Array


class _Carry(NamedTuple):
    particles: Particles
    bodies: FreeBodies
    received: Wrench
    """Impulse and angular impulse so far."""


def no_wrench(num_bodies: int, dtype=None) -> Wrench:
    """No force and no torque."""
    zeros = jnp.zeros((num_bodies, 3), dtype)
    return Wrench(zeros, zeros)


def step(
    scene: MPMScene,
    inertia: Inertia,
    state: MPMState,
    bodies: FreeBodies,
    poses: Pose,
    *,
    wrench: Wrench | None = None,
    store_every: int | None = 1,
) -> tuple[MPMState, FreeBodies, Wrench]:
    """As many substeps as ``poses`` has intervals, of particles and bodies together.

    Args:
      scene: its colliders belong to the free bodies (``Collider.body`` from 0) and, beyond their number, to bodies
        that move as prescribed. Its gravity acts on the free bodies too; its walls do not.
      inertia: mass properties of the free bodies.
      state: particles.
      bodies: free bodies.
      poses: of the bodies that move as prescribed, (num_substeps + 1, num_prescribed, ...); if there are none,
        ``mpm.static_poses(num_substeps)``.
      wrench: further forces and torques on the free bodies, constant in the step; None: no others.
      store_every: as for ``mpm.step``.

    Returns:
      Particles, free bodies, and the mean force and torque that every body (free ones first) got from the particles.
      Linear and angular momentum of particles and free bodies change only by gravity, walls, ``wrench`` and bodies that
      move as prescribed.

    Gradient: exact with respect to everything, forward and reverse, apart from the onset of contact (see
      ``colliders.apply_collider``).
    """
    num_substeps, num_free = poses.position.shape[0] - 1, bodies.position.shape[0]
    num_bodies = num_free + poses.position.shape[1]
    _check(scene, inertia, num_free, num_bodies)
    nodes = nodes_of_step(scene, state.x)
    wrench = no_wrench(num_free, state.x.dtype) if wrench is None else wrench
    one = _substep if store_every is None else _recomputed_substep

    def body(carry: _Carry, interval: tuple[Pose, Pose]) -> _Carry:
        return one(scene, inertia, wrench, nodes, carry, interval)

    start = _Carry(split(state), bodies, no_wrench(num_bodies, state.x.dtype))
    end = scan_substeps(body, start, poses, store_every)
    mean = jax.tree.map(lambda a: a / (num_substeps * scene.dt), end.received)
    return join(end.particles), end.bodies, mean


def _substep(
    scene: MPMScene, inertia: Inertia, wrench: Wrench, nodes: ActiveNodes, carry: _Carry, interval: tuple[Pose, Pose]
) -> _Carry:
    particles, bodies, received = carry
    particles, dt = materialize(particles), scene.dt
    response, fields = to_nodes(scene, nodes, particles)
    has_mass, velocity = free_velocity(scene, fields)
    mass = jnp.where(has_mass, fields.mass, 0.0)
    forced = Wrench(dt * (wrench.force + inertia.mass[:, None] * scene.gravity), dt * wrench.torque)
    pushed = free_body.push(bodies, inertia, *forced)

    starts = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), free_body.poses(pushed), interval[0])
    touches = _touches(scene, nodes.position, starts, pushed, interval)
    predicted = _predict(scene, nodes.position, mass, velocity, touches, pushed, inertia)
    touches = _at_velocity(scene, nodes.position, touches, predicted)
    velocity, impulse, moment = _exchange(scene, nodes.position, mass, velocity, touches, starts.position)

    num_free = bodies.position.shape[0]
    bodies = free_body.move(free_body.push(pushed, inertia, impulse[:num_free], moment[:num_free]), inertia, dt)
    velocity = apply_walls(scene.walls, scene.grid, nodes.index, velocity)
    velocity = cp.vector(lambda i: jnp.where(has_mass, velocity[i], 0.0))
    particles = from_nodes(scene, nodes, particles.x, response, velocity)
    return _Carry(particles, bodies, Wrench(received.force + impulse, received.torque + moment))


_recomputed_substep = recomputed(_substep)


def _touches(
    scene: MPMScene, position: Vec3, starts: Pose, bodies: FreeBodies, interval: tuple[Pose, Pose]
) -> list[Touch]:
    """All colliders at the nodes; the free ones with the velocities that their bodies have now."""
    num_free = bodies.position.shape[0]
    motions = free_body.motions(bodies)

    def motion(collider: Collider) -> Motion:
        if collider.body < num_free:
            return Motion(motions.turn[collider.body], motions.shift[collider.body])
        before, after = (body_pose(p, collider.body - num_free) for p in interval)
        return chord_motion(before, after, scene.dt)

    return [touch(c, position, shape_pose(c, body_pose(starts, c.body)), motion(c)) for c in scene.colliders]


def _at_velocity(scene: MPMScene, position: Vec3, touches: list[Touch], bodies: FreeBodies) -> list[Touch]:
    """The same touches, free bodies moving as given."""
    num_free = bodies.position.shape[0]
    motions = free_body.motions(bodies)
    return [
        t._replace(velocity=velocity_at(Motion(motions.turn[c.body], motions.shift[c.body]), position))
        if c.body < num_free
        else t
        for c, t in zip(scene.colliders, touches, strict=True)
    ]


def _exchange(
    scene: MPMScene, position: Vec3, mass: Array, velocity: Vec3, touches: list[Touch], origins: Array
) -> tuple[Vec3, Array, Array]:
    """Node velocities after contact; impulse on each body and angular impulse about its origin, (num_bodies, 3)."""
    impulses, moments = [jnp.zeros_like(origins)] * 2

    def give(body: int, before: Vec3, after: Vec3, weight: Array) -> None:
        nonlocal impulses, moments
        lost = cp.vector(lambda i: weight * (before[i] - after[i]))
        arm = cp.vector(lambda i: position[i] - origins[body, i])
        total, moment = (jnp.stack([jnp.sum(a) for a in v]) for v in (lost, cp.cross(arm, lost)))
        impulses, moments = impulses.at[body].add(total), moments.at[body].add(moment)

    if scene.overlap is Overlap.SEQUENTIAL or len(touches) < 2:
        for collider, t in zip(scene.colliders, touches, strict=True):
            before, velocity = velocity, materialize(contact_velocity(t, velocity))
            give(collider.body, before, velocity, mass)
        return velocity, impulses, moments
    best, shares = nearest(touches)
    after = materialize(contact_velocity(best, velocity))
    for collider, share in zip(scene.colliders, shares, strict=True):
        give(collider.body, velocity, after, share * mass)
    return after, impulses, moments


def _predict(
    scene: MPMScene,
    position: Vec3,
    mass: Array,
    velocity: Vec3,
    touches: list[Touch],
    bodies: FreeBodies,
    inertia: Inertia,
) -> FreeBodies:
    """The bodies' velocities after contact, if nodes that approach now go on to, and friction acts as it would now.

    With J = (1, -r x) at each node, a touch takes the momentum m W (v - J V) with a symmetric W from a body of twist V:
    (M + sum m J^T W J) dV = sum m J^T W (v - J V).
    """
    alone = scene.overlap is Overlap.SEQUENTIAL or len(touches) < 2
    masses = [mass] * len(touches) if alone else [share * mass for share in nearest(touches)[1]]
    moment = free_body.world_moment(bodies, inertia)
    linear, angular = [], []
    for b in range(bodies.position.shape[0]):
        eye = jnp.eye(3, dtype=moment.dtype)
        system = _System(inertia.mass[b] * eye, jnp.zeros_like(eye), moment[b], jnp.zeros(6, moment.dtype))
        arm = cp.vector(lambda i, b=b: position[i] - bodies.position[b, i])
        for collider, t, weight in zip(scene.colliders, touches, masses, strict=True):
            if collider.body == b:
                system = _add_touch(system, arm, weight, velocity, t)
        dv, dw = _solve(system)
        linear.append(bodies.velocity[b] + dv)
        angular.append(bodies.angular_velocity[b] + dw)
    if not linear:
        return bodies
    return bodies.replace(velocity=jnp.stack(linear), angular_velocity=jnp.stack(angular))


class _System(NamedTuple):
    """Symmetric 6 x 6 system ((a, b), (b^T, c)) of a body's change of twist."""

    a: Array
    b: Array
    c: Array
    right: Array


def _add_touch(system: _System, arm: Vec3, mass: Array, velocity: Vec3, t: Touch) -> _System:
    relative = cp.subtract(velocity, t.velocity)
    approach = jnp.minimum(cp.dot(relative, t.normal), 0.0)
    tangential = cp.vector(lambda i: relative[i] - approach * t.normal[i])
    sliding = friction_factor(tangential, approach, t.friction)
    after = contact_velocity(t, velocity)
    weight = jnp.where((approach < 0) & (t.influence > MIN_INFLUENCE), mass * t.influence, 0.0)
    # W = sliding n n^T + (1 - sliding) 1: sticking nodes take their whole velocity from the body, sliding ones only
    # that along the normal.
    along, whole = materialize((weight * sliding, weight * (1.0 - sliding)))
    q = materialize(jnp.stack([*t.normal, *cp.cross(arm, t.normal)]))
    s = materialize(jnp.stack([jnp.ones_like(arm[0]), *arm]))
    normal = jnp.einsum("an,bn->ab", along * q, q, precision="highest")
    moments = jnp.einsum("an,bn->ab", whole * s, s, precision="highest")
    second = moments[1:, 1:]
    eye = jnp.eye(3, dtype=second.dtype)
    lost = cp.vector(lambda i: mass * (velocity[i] - after[i]))
    right = jnp.stack([jnp.sum(a) for a in (*lost, *cp.cross(arm, lost))])
    return _System(
        system.a + normal[:3, :3] + moments[0, 0] * eye,
        system.b + normal[:3, 3:] - skew(moments[0, 1:]),
        system.c + normal[3:, 3:] + jnp.trace(second) * eye - second,
        system.right + right,
    )


def _solve(system: _System) -> tuple[Array, Array]:
    """Change of velocity and of angular velocity, shapes (3,)."""
    a, b, c, right = system
    from_velocity = solve3(a, jnp.concatenate([b, right[:3, None]], axis=-1))
    schur = c - jnp.matmul(b.T, from_velocity[:, :3], precision="highest")
    angular = solve3(schur, right[3:] - jnp.matmul(b.T, from_velocity[:, 3], precision="highest"))
    return from_velocity[:, 3] - jnp.matmul(from_velocity[:, :3], angular, precision="highest"), angular


def _check(scene: MPMScene, inertia: Inertia, num_free: int, num_bodies: int) -> None:
    if inertia.mass.shape != (num_free,):
        raise ValueError(
            f"inertia is of {inertia.mass.shape} bodies, but there are {num_free} free ones: make both agree"
        )
    check_numbers(inertia_numbers(inertia))
    check_bodies(scene.colliders, num_bodies)
