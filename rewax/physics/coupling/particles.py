"""Particles and free rigid bodies that push each other.

Colliders change the momentum of nodes; what they take is what their bodies receive. So momentum is exchanged, never
made, and a box floats in water because the water holds it up. ``mpm.step`` is the one-way case, in which bodies move
as prescribed; ``articulated`` the one of robots. ``exchange`` says how light bodies stay calm.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.physics.contact.colliders import (
    Collider,
    Motion,
    Touch,
    check_bodies,
    chord_motion,
    shape_pose,
    touch,
)
from rewax.physics.coupling import free_body
from rewax.physics.coupling.exchange import System, Wrench, at_velocity, contact_system, exchange, no_wrench
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
from rewax.types import Array


class _Carry(NamedTuple):
    particles: Particles
    bodies: FreeBodies
    received: Wrench
    """Impulse and angular impulse so far."""


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
    motions = free_body.motions(predicted)
    free = [Motion(*(a[b] for a in motions)) for b in range(bodies.position.shape[0])]
    touches = at_velocity(scene, nodes.position, touches, [*free, *[None] * interval[0].position.shape[0]])
    velocity, impulse, moment = exchange(scene, nodes.position, mass, velocity, touches, starts.position)

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

    return [touch(c, position, shape_pose(c, body_pose(starts, c.body)), motion(c)) for c in scene.sized_colliders]


def _predict(
    scene: MPMScene,
    position: Vec3,
    mass: Array,
    velocity: Vec3,
    touches: list[Touch],
    bodies: FreeBodies,
    inertia: Inertia,
) -> FreeBodies:
    """The bodies' velocities after contact; see ``exchange.contact_system``."""
    moment = free_body.world_moment(bodies, inertia)
    linear, angular = [], []
    for b in range(bodies.position.shape[0]):
        added = contact_system(scene, position, mass, velocity, touches, b, bodies.position[b])
        own = inertia.mass[b] * jnp.eye(3, dtype=moment.dtype)
        dv, dw = _solve(added._replace(a=own + added.a, c=moment[b] + added.c))
        linear.append(bodies.velocity[b] + dv)
        angular.append(bodies.angular_velocity[b] + dw)
    if not linear:
        return bodies
    return bodies.replace(velocity=jnp.stack(linear), angular_velocity=jnp.stack(angular))


def _solve(system: System) -> tuple[Array, Array]:
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
