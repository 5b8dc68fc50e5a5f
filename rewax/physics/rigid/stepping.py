"""Time stepping of articulated rigid bodies.

MJX builds the constraint rows and computes the forces of actuators and tendons (``forces``). It also finds contacts
between kinds of geoms for which rewax has no function (``collide``). Kinematics, dynamics and the solver
(``kinematics``, ``tree_dynamics``, ``solver``) are rewax's own. The derivative of the solver comes from the implicit
function theorem: the reverse derivative neither repeats nor differentiates the solver.

Contact follows one of two laws: MuJoCo's soft constraints, or springs and dampers with regularised Coulomb friction
(``Penalty``). Early simulators for first-order reinforcement learning use the second law.
"""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.machine import interpreted
from rewax.physics.numerics.arguments import check_instance, check_integer, real_array
from rewax.physics.rigid import solver as constraint_solver
from rewax.physics.rigid.forces import (
    applied_forces,
    constraint_rows,
    kinematics,
    mjx_data,
    tree_parameters,
    velocity_damping,
)
from rewax.physics.rigid.kinematics import Kinematics, integrate
from rewax.physics.rigid.mjx_access import mjx
from rewax.physics.rigid.model import RigidModel, RigidState, check_shape, check_state
from rewax.physics.rigid.parameter_checks import has_invalid_parameters
from rewax.physics.rigid.small_products import dot
from rewax.physics.rigid.tree_dynamics import inverse_dynamics, mass_matrix, spin_slopes
from rewax.status import Status, all_finite, flag
from rewax.types import Array

_MIN_ITERATIONS = 50
"""Smallest limit of solver iterations, which end when the solution has converged: the derivative is exact only then."""


def initial_state(
    model: RigidModel, qpos: Array | np.ndarray | None = None, qvel: Array | np.ndarray | None = None
) -> RigidState:
    """A state with given positions and velocities; by default the model's home at rest. Activations are zero.

    Raises:
      ValueError: a shape differs from the model's, a value is not finite, or a quaternion has length 0.

    Gradient: exact.
    """
    check_instance("model", model, RigidModel, "give a model that rigid.load returned")
    dtype = model.parameters["qpos0"].dtype
    positions = "give joint positions, such as model.home"
    # array, not asarray: MuJoCo may overwrite its own arrays.
    qpos = model.home if qpos is None else jnp.array(real_array("qpos", qpos, positions), dtype)
    qvel = (
        jnp.zeros(model.num_dofs, dtype)
        if qvel is None
        else jnp.array(real_array("qvel", qvel, "give joint velocities"), dtype)
    )
    for name, value, size in (("qpos", qpos, model.num_positions), ("qvel", qvel, model.num_dofs)):
        check_shape(name, value, (size,))
        if not isinstance(value, jax.core.Tracer) and not bool(jnp.all(jnp.isfinite(value))):
            raise ValueError(f"{name} holds a number that is not finite ({value}): give a finite start")
    for start, _ in model.static.topology.quaternions:
        if not isinstance(qpos, jax.core.Tracer) and not np.any(np.asarray(qpos)[start : start + 4]):
            raise ValueError(f"qpos[{start}:{start + 4}] is a quaternion of zeros: give (1, 0, 0, 0) for no rotation")
    act = jnp.zeros(model.static.mj.na, qpos.dtype)
    nothing = jnp.zeros((), qpos.dtype)
    return RigidState(qpos=qpos, qvel=qvel, act=act, qacc=jnp.zeros(model.num_dofs, qpos.dtype), unsolved=nothing)


def step(
    model: RigidModel,
    state: RigidState,
    ctrl: Array | None = None,
    *,
    wrenches: Array | None = None,
    num_substeps: int = 1,
) -> RigidState:
    """The state ``num_substeps`` substeps of ``model.dt`` later, with the model's integrator.

    ``Euler`` is semi-implicit, and implicit in the damping of joints. ``implicitfast`` is implicit in all damping (of
    joints, tendons and actuators) and in the gyroscopic terms of single free bodies.

    Args:
      model: bodies, actuators, contact law.
      state: initial state.
      ctrl: constant controls, shape (num_actuators,); None: zero.
      wrenches: constant force [N] and torque [N m] at each body's center of mass, world axes, shape (num_bodies, 6);
        None: zero.
      num_substeps: number of substeps, at least 1.

    Gradient: exact for the discrete map, forward (JVP) and reverse (VJP), with respect to state, controls, wrenches and
      parameters. The reverse derivative stores one state per substep. Zero through ``qacc`` and saturated controls. The
      derivative assumes that the solver has converged. Its limit is the model's ``iterations``, but at least 50; where
      it does not suffice, ``check_status`` sets ``Status.UNSOLVED``.
    Source: MuJoCo's ``mj_Euler`` and ``mj_implicit``; CRBA and RNEA: Featherstone 2008, "Rigid Body Dynamics
      Algorithms"; constraint forces: Todorov 2014, "Convex and analytically-invertible dynamics with contacts and
      constraints", section IV. Deviation: the solver has its own line search.

    Raises:
      ValueError: a shape differs from the model's, an argument is not a number, or the model or the state has another
        precision than JAX has now.
    """
    check_state(model, state)
    ctrl, wrenches = checked_inputs(model, ctrl, wrenches, num_substeps, state.qpos.dtype)

    def substep(state: RigidState, _: None) -> tuple[RigidState, None]:
        return _substep(model, state, ctrl, wrenches)[0], None

    return jax.lax.scan(substep, forgotten(state), None, length=num_substeps)[0]


def forgotten(state: RigidState) -> RigidState:
    """The state at the beginning of a step, which has no unsolved substep yet."""
    return state.replace(unsolved=jnp.zeros_like(state.unsolved))


def checked_inputs(
    model: RigidModel, ctrl: Array | None, wrenches: Array | None, num_substeps: int, dtype: Any
) -> tuple[Array, Array]:
    """Controls and wrenches of ``step`` as arrays of the state's dtype, zero by default.

    Raises:
      ValueError: a shape differs from the model's, an argument is not a number, or the model or the state has another
        precision than JAX has now.
    """
    own, now = model.parameters["qpos0"].dtype, jnp.zeros(()).dtype
    if not own == dtype == now:
        raise ValueError(
            f"the model has numbers of {own} and its state of {dtype}, but JAX computes with {now} here: load the "
            "model and make its state while jax.enable_x64 is as now"
        )
    ctrl = jnp.zeros(model.num_actuators, dtype) if ctrl is None else real_array("ctrl", ctrl, "give an array")  # pyright: ignore[reportAssignmentType]
    wrenches = (  # pyright: ignore[reportAssignmentType]
        jnp.zeros((model.num_bodies, 6), dtype)
        if wrenches is None
        else real_array("wrenches", wrenches, "give an array")
    )
    ctrl, wrenches = jnp.asarray(ctrl, dtype), jnp.asarray(wrenches, dtype)
    check_shape("ctrl", ctrl, (model.num_actuators,), " (one number per actuator of the model)")
    check_shape("wrenches", wrenches, (model.num_bodies, 6), " (force and torque per body, the world included)")
    check_integer("num_substeps", num_substeps, 1)
    return ctrl, wrenches


def check_status(state: RigidState, model: RigidModel | None = None) -> Array:
    """Status bits of a state and of its model.

    Args:
      state: the bodies. A value that is not finite, or a position or velocity of a million or more, sets ``NAN``. A
        substep of the last step whose constraint forces did not balance sets ``UNSOLVED``.
      model: illegal parameters (not finite; a mass, size or friction below 0; a range whose lower limit is the larger
        one; axes and quaternions whose length is not 1) set ``INVALID_PARAMETERS``; None: do not check parameters.

    Returns:
      Bits of ``rewax.status.Status``, shape (), int32. Gradient: none.
    """
    check_instance("state", state, RigidState, "give a state that rigid.initial_state returned")
    largest = jnp.max(jnp.abs(jnp.concatenate([state.qpos, state.qvel])), initial=0.0)
    status = flag(~(largest < 1e6) | ~all_finite((state.act, state.qacc)), Status.NAN)
    status |= flag(state.unsolved > 0, Status.UNSOLVED)
    if model is None:
        return status
    static = model.static
    invalid = has_invalid_parameters(model.parameters, model.gravity, model.penalty, static.mj, static.on_field)
    return status | flag(invalid, Status.INVALID_PARAMETERS)


def rates(model: RigidModel, state: RigidState, ctrl: Array, wrenches: Array) -> tuple[Array, RigidState]:
    """The change of velocity in a substep.

    Args:
      model, state: as for ``step``.
      ctrl, wrenches: as for ``step``, but not None.

    Returns:
      The change of velocity per time [m/s^2, rad/s^2], shape (num_dofs,), and the state after the substep. If the
      caller replaces this state's velocity, its activations, ``qacc`` and ``unsolved`` stay valid. Gradient: exact.
    """
    after, rate = _substep(model, state, ctrl, wrenches)
    return rate, after


# --- One substep ------------------------------------------------------------------------------------------------------


def _accelerate(model: RigidModel, state: RigidState, ctrl: Array, wrenches: Array) -> tuple[RigidState, Array]:
    """The state after one substep, and its change of velocity per time, shape (num_dofs,)."""
    with jax.default_matmul_precision("highest"):
        topology, parameters = model.static.topology, tree_parameters(model)
        kin = kinematics(model, state.qpos)
        m, d = mjx_data(model, kin, state, ctrl)
        applied, act = applied_forces(model, kin, m, d, wrenches)
        rows = constraint_rows(model, kin, m, d)
        still = jnp.zeros_like(state.qvel)
        force = applied - inverse_dynamics(topology, parameters, kin, state.qvel, still, model.gravity)
        mass = mass_matrix(topology, parameters, kin)
        qacc, unsolved = constraint_solver.solve_accelerations(
            mass,
            force,
            rows,
            state.qacc,
            max_iterations=max(model.static.mj.opt.iterations, _MIN_ITERATIONS),
            num_bounded=model.static.num_bounded,
        )
        rate = qacc
        if model.static.has_damping:
            total = force + rows.jacobian.T @ constraint_solver.row_forces(rows, qacc)
            rate = constraint_solver.solve_spd(_damped(model, kin, m, d, mass, qacc)[0], total)
        return _advance(model, state, act, qacc, rate, jnp.maximum(state.unsolved, unsolved)), rate


def _acceleration_derivative(
    known: tuple[RigidState, Array], model: RigidModel, state: RigidState, ctrl: Array, wrenches: Array
) -> tuple[RigidState, Array]:
    """The result of ``_accelerate``, ``known``, with a derivative that follows from the balance of forces."""
    with jax.default_matmul_precision("highest"):
        topology, parameters = model.static.topology, tree_parameters(model)
        qacc, unsolved, rate = jax.lax.stop_gradient((known[0].qacc, known[0].unsolved, known[1]))
        kin = kinematics(model, state.qpos)
        m, d = mjx_data(model, kin, state, ctrl)
        applied, act = applied_forces(model, kin, m, d, wrenches)
        rows = constraint_rows(model, kin, m, d)
        mass = mass_matrix(topology, *jax.lax.stop_gradient((parameters, kin)))

        accelerations = jnp.stack([qacc, rate] if model.static.has_damping else [qacc])
        needed = jax.vmap(lambda a: inverse_dynamics(topology, parameters, kin, state.qvel, a, model.gravity))(
            accelerations
        )

        def correction(matrix: Array, needed: Array, forces: Array, symmetric: bool = True) -> Array:
            residual = needed - applied - rows.jacobian.T @ forces
            return constraint_solver.implicit_correction(matrix, residual, symmetric=symmetric)

        matrix = constraint_solver.curvature(mass, jax.lax.stop_gradient(rows), qacc)
        solved = qacc - correction(matrix, needed[0], constraint_solver.row_forces(rows, qacc))
        if model.static.has_damping:
            held = constraint_solver.row_forces(rows, solved)
            damped, damping = _damped(model, kin, m, d, mass, rate)
            solved = rate - correction(damped, needed[1] + damping, held, not len(model.static.lone_dofs))
        return _advance(model, state, act, qacc, solved, unsolved), solved


_substep = interpreted(_accelerate, derivative_of=_acceleration_derivative)


def _damped(
    model: RigidModel, kin: Kinematics, m: mjx.Model, d: mjx.Data, mass: Array, rate: Array
) -> tuple[Array, Array]:
    """Matrix of a step that is implicit in velocity, and the damping force at an acceleration.

    MuJoCo's Euler integrator treats only the damping of joints implicitly. Its integrator ``implicitfast`` treats all
    damping implicitly, and the gyroscopic terms of single free bodies.
    """
    if not model.static.is_implicit:
        damping = model.dt * model.parameters["dof_damping"]
        return mass + jnp.diag(damping), damping * rate
    damping, lone = velocity_damping(model, m, d), model.static.lone_dofs
    if len(lone):
        damping += spin_slopes(model.static.topology, tree_parameters(model), kin, d.qvel, lone)
    return mass + model.dt * damping, model.dt * dot(damping, rate)


def _advance(model: RigidModel, state: RigidState, act: Array, qacc: Array, rate: Array, unsolved: Array) -> RigidState:
    qvel = state.qvel + model.dt * rate
    return RigidState(
        qpos=integrate(model.static.topology, state.qpos, qvel, model.dt),
        qvel=qvel,
        act=act,
        qacc=jax.lax.stop_gradient(qacc),
        unsolved=jax.lax.stop_gradient(unsolved),
    )


__all__ = ["check_status", "checked_inputs", "forgotten", "initial_state", "rates", "step"]
