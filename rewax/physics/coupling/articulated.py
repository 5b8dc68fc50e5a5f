"""Two-way coupling of soft bodies with articulated rigid bodies.

Colliders of the scene belong to bodies of an MJCF model. The momentum that they take from the soft body acts on the
joints through the model's mass matrix M. Contact uses the bodies' velocity after contact. Its prediction adds
S_b^T A_b S_b to M for each touched body b, where S_b q' is the twist of b and A_b the matrix of ``exchange.System``. So
a light finger in heavy dough is stable at the soft body's own substep, for any mass.

The model's own forces (gravity, actuators, springs, contacts and limits) are evaluated once per rigid substep. A rigid
substep may last several substeps of the soft body; each of them updates mass matrix, poses and exchange of momentum.
The own forces act as one impulse in the first of them. Spread over all, they would add energy to springs and servos:
without contact, the robot moves as in ``rigid.step``.
"""

# pyright: reportAttributeAccessIssue=false

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import check_bodies
from rewax.physics.contact.motion import Motion
from rewax.physics.contact.patches import accumulated, check_patches, felt, no_touch
from rewax.physics.coupling.exchange import SoftContact, Wrench, no_wrench
from rewax.physics.coupling.soft import (
    SCENE,
    Scene,
    Soft,
    check_state,
    prescribed_of,
    scan_soft,
    solver_of,
    touched_bodies,
)
from rewax.physics.numerics.checks import check_precision
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.rotations import skew
from rewax.physics.rigid import RigidModel, RigidState
from rewax.physics.rigid.forces import kinematics, tree_parameters
from rewax.physics.rigid.kinematics import Kinematics, body_velocities, generalized_forces, integrate
from rewax.physics.rigid.model import check_state as check_robot
from rewax.physics.rigid.solver import implicit_correction, solve_spd
from rewax.physics.rigid.stepping import checked_inputs, rates
from rewax.physics.rigid.touch import felt_contacts
from rewax.physics.rigid.tree_dynamics import mass_matrix
from rewax.physics.thin.prescribed import Prescribed
from rewax.types import Array


class _Carry(NamedTuple):
    soft: Any
    qpos: Array
    qvel: Array
    received: Wrench
    """Accumulated impulse and angular impulse on each body."""
    felt: Any = None
    """The same on each patch; None: nobody asked."""


def step(
    scene: Scene,
    model: RigidModel,
    state: Soft,
    bodies: RigidState,
    ctrl: Array | None = None,
    *,
    num_substeps: int = 1,
    wrenches: Array | None = None,
    pins: Array | None = None,
    grips: Array | None = None,
) -> tuple[Soft, RigidState, Wrench]:
    """Advance a soft body and a robot together by ``num_substeps`` rigid substeps of ``model.dt``.

    Args:
      scene: particles, tetrahedra, or cloth and ropes. Its colliders and grasps belong to bodies of the model
        (``rigid.colliders``); body 0 is the world. ``scene.dt`` divides ``model.dt``. Gravity, walls and ground of the
        scene act on the soft body, the model's gravity on the robot.
      model: the robot.
      state: state of the soft body.
      bodies: the robot's state.
      ctrl: controls, constant in the step, shape (num_actuators,); None: zero.
      num_substeps: number of rigid substeps, at least 1 (static).
      wrenches: further forces and torques on the bodies, as for ``rigid.step``.
      pins, grips: as for ``thin.step``, with one entry for each of the soft body's substeps.

    Returns:
      The soft body, the robot, and the mean force and torque of the soft body on every body, about the origin of the
      body's frame, shapes (num_bodies, 3). Contact conserves momentum.

    Gradient: exact with respect to everything, forward and reverse, except at the onset of contact (see
      ``contact.apply_collider`` and ``contact.penalty_force``). The backward pass stores soft body and robot at each
      of the soft body's substeps.

    Raises:
      ValueError: ``scene.dt`` does not divide ``model.dt``; a shape does not fit; arrays differ in precision; cloth
        that yields or has a ``stepper``.
    """
    return _advanced(scene, model, state, bodies, ctrl, num_substeps, wrenches, None, (pins, grips))[:3]


def step_with_touch(
    scene: Scene,
    model: RigidModel,
    state: Soft,
    bodies: RigidState,
    ctrl: Array | None = None,
    *,
    patches: Any,
    num_substeps: int = 1,
    wrenches: Array | None = None,
    pins: Array | None = None,
    grips: Array | None = None,
) -> tuple[Soft, RigidState, Wrench, Any]:
    """``step``, and the mean force and torque on patches of bodies: of the soft body, and of contacts of the robot.

    Args:
      scene, model, state, bodies, ctrl, num_substeps, wrenches, pins, grips: as for ``step``.
      patches: ``contact.Patches``, or a dict of them; ``contact.WALLS`` are walls and ground of the scene.

    Returns:
      The results of ``step``. Force [N] and torque [N m] on each patch, see ``mpm.step_with_touch`` and
      ``rigid.step_with_touch``.

    Gradient: exact, as for ``step``. None by which patch a contact point is nearest to.

    Raises:
      ValueError: as for ``step``, or a patch belongs to no body of the model.
    """
    check_patches(patches, model.num_bodies)
    return _advanced(scene, model, state, bodies, ctrl, num_substeps, wrenches, patches, (pins, grips))


def _advanced(
    scene: Scene,
    model: RigidModel,
    state: Soft,
    bodies: RigidState,
    ctrl: Array | None,
    num_substeps: int,
    wrenches: Array | None,
    patches: Any,
    given: tuple[Array | None, Array | None],
) -> tuple[Soft, RigidState, Wrench, Any]:
    SCENE("scene", scene)
    check_state(scene, state)
    check_robot(model, bodies)
    check_precision(state.x, scene.gravity, bodies.qpos)
    dtype = state.x.dtype
    ctrl, wrenches = checked_inputs(model, ctrl, wrenches, num_substeps, dtype)
    each, solver = soft_substeps(scene, model), solver_of(scene)
    check_bodies(scene.colliders, model.num_bodies)
    prescribed = prescribed_of(scene, state, *given, num_substeps * each, model.num_bodies)
    constants = solver.constants(scene, state)
    prescribed = jax.tree.map(lambda a: a.reshape(num_substeps, each, *a.shape[1:]), prescribed)

    def rigid_substep(carry: tuple[_Carry, dict[str, Array]], now: Prescribed) -> tuple[Any, Any]:
        inner, kept = carry
        robot = RigidState(qpos=inner.qpos, qvel=inner.qvel, **kept)
        rate, after = rates(model, robot, ctrl, wrenches)
        if patches is not None:
            contacts = felt_contacts(model, robot, after.qacc, ctrl, wrenches, patches)
            inner = inner._replace(felt=accumulated(inner.felt, contacts, model.dt))

        def substep(inner: _Carry, interval: tuple[Array, Prescribed], constants: Any) -> _Carry:
            kick = jnp.where(interval[0] == 0, each * scene.dt, 0.0) * rate
            return _substep(scene, model, constants, kick, inner, patches, interval[1])

        inner, seen = scan_soft(scene, constants, substep, inner, (jnp.arange(each), now), None)
        return (inner, {"act": after.act, "qacc": after.qacc, "unsolved": after.unsolved}), seen

    untouched = None if patches is None else no_touch(patches, state.x)
    start = _Carry(solver.split(state), bodies.qpos, bodies.qvel, no_wrench(model.num_bodies, state.x), untouched)
    kept = {"act": bodies.act, "qacc": bodies.qacc, "unsolved": jnp.zeros_like(bodies.unsolved)}
    (end, kept), seen = jax.lax.scan(rigid_substep, (start, kept), prescribed, length=num_substeps)
    mean, felt = jax.tree.map(lambda a: a / (num_substeps * each * scene.dt), (end.received, end.felt))
    soft = solver.remember(state, solver.join(end.soft), jax.tree.map(jnp.max, seen))
    return soft, RigidState(qpos=end.qpos, qvel=end.qvel, **kept), mean, felt


def soft_substeps(scene: Scene, model: RigidModel) -> int:
    """Number of soft substeps in one rigid substep.

    Raises:
      ValueError: the number is no integer.
    """
    each = model.dt / scene.dt
    if abs(each - round(each)) > 1e-6 * each or round(each) < 1:
        raise ValueError(
            f"the scene's dt {scene.dt:g} s does not divide the model's {model.dt:g} s: choose a model.dt that is an "
            "integer multiple of scene.dt"
        )
    return round(each)


def _exchanging_substep(
    scene: Scene, model: RigidModel, constants: Any, kick: Array, carry: _Carry, patches: Any, prescribed: Prescribed
) -> _Carry:
    """One soft substep; ``kick`` is the change of the joints' velocities by the robot's own forces."""
    soft, qpos, before, received, touch = carry
    contact, dt = solver_of(scene).begin(scene, constants, soft, prescribed), scene.dt

    with jax.default_matmul_precision("highest"):
        kin = kinematics(model, qpos)
        inertia = mass_matrix(model.static.topology, tree_parameters(model), kin)
        qvel = before + kick
        poses = Pose(kin.position, kin.rotation)
        contact = contact.meet(poses, _motions(model, kin, qvel), lambda: _motions(model, kin, before))
        change = _predicted_change(scene, model, contact, kin, inertia)
        contact, (impulse, moment) = contact.exchange(_motions(model, kin, qvel + change), kin.tree_com)
        given = generalized_forces(model.static.topology, kin, jnp.concatenate([moment, impulse], axis=-1))
        qvel = qvel + _solve(inertia, given)
        qpos = integrate(model.static.topology, qpos, qvel, dt)

    about_frame = moment + jnp.cross(kin.tree_com - kin.position, impulse)
    received = Wrench(received.force + impulse, received.torque + about_frame)
    if patches is not None:
        touch = accumulated(touch, felt(patches, *contact.given(), poses))
    return _Carry(contact.finish(), qpos, qvel, received, touch)


_substep = recomputed(_exchanging_substep)


def _motions(model: RigidModel, kin: Kinematics, qvel: Array) -> list[Motion]:
    """Velocity fields of all bodies."""
    twist = body_velocities(model.static.topology, kin, qvel)
    turn = skew(twist[:, :3])
    shift = twist[:, 3:] - jnp.einsum("bij,bj->bi", turn, kin.tree_com)
    return [Motion(turn[b], shift[b]) for b in range(model.num_bodies)]


def _predicted_change(scene: Scene, model: RigidModel, contact: SoftContact, kin: Kinematics, inertia: Array) -> Array:
    """Predicted change of joint velocities by contact, shape (num_dofs,); see ``exchange.System``."""
    matrix, right = inertia, jnp.zeros_like(inertia[0])
    moves = model.static.topology.moves
    for body in touched_bodies(scene):
        if not np.any(moves[body]):
            continue
        system = contact.system(body, kin.tree_com[body])
        axes = kin.axes.T * moves[body]  # this body's twist per joint rate, (6, num_dofs), angular first
        whole = jnp.block([[system.c, system.b.T], [system.b, system.a]])
        matrix = matrix + axes.T @ whole @ axes
        right = right + axes.T @ jnp.concatenate([system.right[3:], system.right[:3]])
    return _solve(matrix, right)


def _solve(matrix: Array, right: Array) -> Array:
    """Solution of a symmetric, positive definite system, shape (n,). Gradient: exact."""
    found = jax.lax.stop_gradient(solve_spd(jax.lax.stop_gradient(matrix), jax.lax.stop_gradient(right)))
    return found - implicit_correction(matrix, matrix @ found - right)


__all__ = ["soft_substeps", "step", "step_with_touch"]
