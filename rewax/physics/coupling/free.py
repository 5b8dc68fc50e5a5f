"""Two-way coupling of soft bodies with free rigid bodies.

Bodies receive the momentum that their colliders take from the soft body. So contact conserves momentum: a box floats,
because the water supports it. ``mpm.step`` and ``tets.step`` are the one-way case with prescribed motion.
``articulated`` couples robots. ``exchange`` describes how the contact of light bodies stays stable.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import check_bodies
from rewax.physics.contact.motion import Motion, chord_motion
from rewax.physics.coupling import free_body
from rewax.physics.coupling.exchange import WRENCH, SoftContact, System, Wrench, no_wrench
from rewax.physics.coupling.free_body import BODIES, INERTIA, FreeBodies, Inertia, inertia_numbers, solve3
from rewax.physics.coupling.soft import SCENE, STATE, Scene, Soft, prescribed_of, scan_soft, solver_of
from rewax.physics.numerics.checks import check_numbers, check_precision
from rewax.physics.numerics.fields import checked, optional
from rewax.physics.numerics.fields import poses as poses_of
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.numerics.substeps import both_ends, check_has_substeps
from rewax.physics.thin.stepping import Interval
from rewax.types import Array


class _Carry(NamedTuple):
    soft: Any
    bodies: FreeBodies
    received: Wrench
    """Accumulated impulse and angular impulse."""


@checked(
    scene=SCENE,
    inertia=INERTIA,
    state=STATE,
    bodies=BODIES,
    poses=poses_of("num_substeps + 1", "num_prescribed"),
    wrench=optional(WRENCH),
)
def step(
    scene: Scene,
    inertia: Inertia,
    state: Soft,
    bodies: FreeBodies,
    poses: Pose,
    *,
    wrench: Wrench | None = None,
    pins: Array | None = None,
    grips: Array | None = None,
    store_every: int | None = 1,
) -> tuple[Soft, FreeBodies, Wrench]:
    """Advance a soft body and free rigid bodies together by the substeps between ``poses``.

    Args:
      scene: particles, tetrahedra, or cloth and ropes. ``Collider.body`` and ``Grasp.body`` count the free bodies from
        0, then the bodies with prescribed motion. Gravity acts on the free bodies too; walls and ground do not.
      inertia: mass properties of the free bodies.
      state: state of the soft body.
      bodies: free bodies.
      poses: poses of the bodies with prescribed motion, shapes (num_substeps + 1, num_prescribed, ...). If there are no
        such bodies, give ``mpm.static_poses(num_substeps)``.
      wrench: additional force [N] and torque [N m] on each free body at its center of mass, world axes, constant in
        the step, shape (num_free, 3) each; None: none.
      pins, grips: as for ``thin.step``.
      store_every: as for ``mpm.step``.

    Returns:
      The soft body, the free bodies, and the mean force [N] and torque [N m] of the soft body on every body, shape
      (num_bodies, 3) each, free bodies first.

    The total momentum changes only by gravity, walls, ground, held vertices, ``wrench``, prescribed motion and the
    ``drag`` of cloth. Angular momentum also changes by ``DampingLaw.VELOCITY_GRADIENT`` of tetrahedra, and by friction
    between layers of cloth and between cloth and particles.

    Gradient: exact with respect to everything, forward and reverse, except at the onset of contact (see
      ``contact.apply_collider`` and ``contact.penalty_force``).

    Raises:
      ValueError: scene, state, bodies, inertia, poses, pins, grips and ``wrench`` do not fit each other or differ in
        precision; illegal mass properties; no substep; ``store_every`` does not divide the number of substeps; cloth
        that yields or has a ``stepper``.
    """
    free_body.check_bodies(bodies)
    num_substeps, num_free = poses.position.shape[0] - 1, bodies.position.shape[0]
    num_bodies = num_free + poses.position.shape[1]
    _check(scene, inertia, num_free, num_bodies, wrench)
    check_precision(state.x, scene.gravity, poses.position, bodies.position)
    check_has_substeps(num_substeps)
    solver = solver_of(scene)
    prescribed = prescribed_of(scene, state, pins, grips, num_substeps, num_bodies)
    wrench = no_wrench(num_free, state.x) if wrench is None else wrench
    one = _substep if store_every is None else _recomputed_substep

    def body(carry: _Carry, interval: Interval, constants: Any) -> _Carry:
        return one(scene, inertia, wrench, constants, carry, interval)

    start = _Carry(solver.split(state), bodies, no_wrench(num_bodies, state.x))
    intervals = Interval(both_ends(poses), prescribed)
    end, seen = scan_soft(scene, solver.constants(scene, state), body, start, intervals, store_every)
    mean = jax.tree.map(lambda a: a / (num_substeps * scene.dt), end.received)
    return solver.remember(state, solver.join(end.soft), seen), end.bodies, mean


def step_prescribed(
    scene: Scene,
    state: Soft,
    poses: Pose,
    *,
    pins: Array | None = None,
    grips: Array | None = None,
    store_every: int | None = 1,
) -> Soft:
    """``step`` without free bodies: the step of a mixed scene whose bodies all move as prescribed.

    Args:
      scene, state, poses, pins, grips, store_every: as for ``step``.

    Returns:
      The soft body.

    Gradient: exact, as for ``step``.
    """
    zeros = jnp.zeros_like(state.x, shape=(0, 3))
    none = Inertia(mass=zeros[:, 0], moment=jnp.zeros_like(zeros, shape=(0, 3, 3)))
    bodies = free_body.bodies_at_rest(zeros)
    return step(scene, none, state, bodies, poses, pins=pins, grips=grips, store_every=store_every)[0]


def _substep(scene: Scene, inertia: Inertia, wrench: Wrench, constants: Any, carry: _Carry, given: Interval) -> _Carry:
    (soft, bodies, received), (interval, prescribed) = carry, given
    contact, dt = solver_of(scene).begin(scene, constants, soft, prescribed), scene.dt
    forced = Wrench(dt * (wrench.force + inertia.mass[:, None] * scene.gravity), dt * wrench.torque)
    pushed = free_body.push(bodies, inertia, *forced)

    num_free = bodies.position.shape[0]
    starts = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), free_body.poses(pushed), interval[0])
    driven = _prescribed(interval, dt)
    contact = contact.meet(starts, [*_motions(pushed), *driven], lambda: [*_motions(bodies), *driven])
    predicted = _motions(_predict(contact, pushed, inertia))
    contact, gained = contact.exchange([*predicted, *[None] * len(driven)], starts.position)

    pushed = free_body.push(pushed, inertia, *(a[:num_free] for a in gained))
    bodies = free_body.move(pushed, inertia, dt)
    return _Carry(contact.finish(), bodies, Wrench(received.force + gained.impulse, received.torque + gained.moment))


_recomputed_substep = recomputed(_substep)


def _motions(bodies: FreeBodies) -> list[Motion]:
    """Velocity field of each free body."""
    motions = free_body.motions(bodies)
    return [Motion(*(a[b] for a in motions)) for b in range(bodies.position.shape[0])]


def _prescribed(interval: tuple[Pose, Pose], dt: float) -> list[Motion]:
    """Velocity field of each body with prescribed motion."""
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


def _check(scene: Scene, inertia: Inertia, num_free: int, num_bodies: int, wrench: Wrench | None) -> None:
    check_numbers(inertia_numbers(inertia))
    for name, array in () if wrench is None else zip(("force", "torque"), wrench, strict=True):
        if array.shape != (num_free, 3):
            raise ValueError(
                f"wrench.{name} has shape {array.shape}: give one of shape ({num_free}, 3), a row for each free body"
            )
    if inertia.mass.shape != (num_free,):
        raise ValueError(
            f"inertia has {len(inertia.mass)} bodies, but there are {num_free} free bodies: give the mass properties "
            "of each free body"
        )
    check_bodies(scene.colliders, num_bodies)
