"""Soft bodies and free rigid bodies that push each other.

What colliders take from the soft body is what their bodies receive. So momentum is exchanged, never made, and a box
floats in water because the water holds it up. ``mpm.step`` and ``tets.step`` are the one-way case, in which bodies move
as prescribed; ``articulated`` the one of robots. ``exchange`` says how light bodies stay calm.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import check_bodies
from rewax.physics.contact.motion import Motion, chord_motion
from rewax.physics.coupling import free_body
from rewax.physics.coupling.exchange import SoftContact, System, Wrench, no_wrench
from rewax.physics.coupling.free_body import FreeBodies, Inertia, inertia_numbers, solve3
from rewax.physics.coupling.soft import Scene, Soft, solver_of
from rewax.physics.numerics.checks import check_numbers
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.numerics.substeps import both_ends, scan_substeps
from rewax.types import Array


class _Carry(NamedTuple):
    soft: Any
    bodies: FreeBodies
    received: Wrench
    """Impulse and angular impulse so far."""


def step(
    scene: Scene,
    inertia: Inertia,
    state: Soft,
    bodies: FreeBodies,
    poses: Pose,
    *,
    wrench: Wrench | None = None,
    store_every: int | None = 1,
) -> tuple[Soft, FreeBodies, Wrench]:
    """As many substeps as ``poses`` has intervals, of a soft body and rigid ones together.

    Args:
      scene: particles or tetrahedra; its colliders belong to the free bodies (``Collider.body`` from 0) and, beyond
        their number, to bodies that move as prescribed. Its gravity acts on the free bodies too; its walls and ground
        do not.
      inertia: mass properties of the free bodies.
      state: particles or vertices.
      bodies: free bodies.
      poses: of the bodies that move as prescribed, (num_substeps + 1, num_prescribed, ...); if there are none,
        ``mpm.static_poses(num_substeps)``.
      wrench: further forces and torques on the free bodies, constant in the step; None: no others.
      store_every: as for ``mpm.step``.

    Returns:
      The soft body, the free bodies, and the mean force and torque that every body (free ones first) got from it.
      Linear and angular momentum of all together change only by gravity, walls, ground, held vertices, ``wrench`` and
      bodies that move as prescribed.

    Gradient: exact with respect to everything, forward and reverse, apart from the onset of contact (see
      ``colliders.apply_collider`` and ``penalty.penalty_force``).
    """
    num_substeps, num_free = poses.position.shape[0] - 1, bodies.position.shape[0]
    num_bodies = num_free + poses.position.shape[1]
    _check(scene, inertia, num_free, num_bodies)
    solver = solver_of(scene)
    constants = solver.constants(scene, state)
    wrench = no_wrench(num_free, state.x) if wrench is None else wrench
    one = _substep if store_every is None else _recomputed_substep

    def body(carry: _Carry, interval: tuple[Pose, Pose]) -> _Carry:
        return one(scene, inertia, wrench, constants, carry, interval)

    start = _Carry(solver.split(state), bodies, no_wrench(num_bodies, state.x))
    end = scan_substeps(body, start, both_ends(poses), store_every)
    mean = jax.tree.map(lambda a: a / (num_substeps * scene.dt), end.received)
    return solver.join(end.soft), end.bodies, mean


def _substep(
    scene: Scene, inertia: Inertia, wrench: Wrench, constants: Any, carry: _Carry, interval: tuple[Pose, Pose]
) -> _Carry:
    soft, bodies, received = carry
    contact, dt = solver_of(scene).begin(scene, constants, soft), scene.dt
    forced = Wrench(dt * (wrench.force + inertia.mass[:, None] * scene.gravity), dt * wrench.torque)
    pushed = free_body.push(bodies, inertia, *forced)

    num_free = bodies.position.shape[0]
    starts = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), free_body.poses(pushed), interval[0])
    prescribed = _prescribed(interval, dt)
    contact = contact.meet(starts, [*_motions(pushed), *prescribed], lambda: [*_motions(bodies), *prescribed])
    predicted = _motions(_predict(contact, pushed, inertia))
    contact, given = contact.exchange([*predicted, *[None] * len(prescribed)], starts.position)

    pushed = free_body.push(pushed, inertia, *(a[:num_free] for a in given))
    bodies = free_body.move(pushed, inertia, dt)
    return _Carry(contact.finish(), bodies, Wrench(received.force + given.impulse, received.torque + given.moment))


_recomputed_substep = recomputed(_substep)


def _motions(bodies: FreeBodies) -> list[Motion]:
    """Velocity field of each body."""
    motions = free_body.motions(bodies)
    return [Motion(*(a[b] for a in motions)) for b in range(bodies.position.shape[0])]


def _prescribed(interval: tuple[Pose, Pose], dt: float) -> list[Motion]:
    """Of each body that moves as prescribed."""
    return [chord_motion(*(body_pose(p, b) for p in interval), dt) for b in range(interval[0].position.shape[0])]  # pyright: ignore[reportCallIssue]


def _predict(contact: SoftContact, bodies: FreeBodies, inertia: Inertia) -> FreeBodies:
    """The bodies' velocities after contact; see ``exchange.System``."""
    moment = free_body.world_moment(bodies, inertia)
    linear, angular = [], []
    for b in range(bodies.position.shape[0]):
        added = contact.system(b, bodies.position[b])
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


def _check(scene: Scene, inertia: Inertia, num_free: int, num_bodies: int) -> None:
    if inertia.mass.shape != (num_free,):
        raise ValueError(
            f"inertia is of {inertia.mass.shape} bodies, but there are {num_free} free ones: make both agree"
        )
    check_numbers(inertia_numbers(inertia))
    check_bodies(scene.colliders, num_bodies)
