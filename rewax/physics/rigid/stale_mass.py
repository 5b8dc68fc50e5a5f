"""Substeps that share one mass matrix, as Warp's Featherstone integrator takes them.

Warp's integrator can compute the mass matrix at the first of several substeps and keep it for the others
(``update_mass_matrix_every``). The velocity of its free joint is a twist about the world's origin: the angular
velocity, and the velocity of the body's point at the origin. A mass matrix kept in these coordinates describes a body
at its old position. Once the body has moved by r, a force f on it also acts like a torque r x f that does not exist.
The error grows with the speed and the number of substeps.

This module serves comparisons with that simulator. ``stepping.step`` renews the mass matrix at every substep.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.machine import interpreted
from rewax.physics.numerics.rotations import normalized, quaternion_to_matrix
from rewax.physics.rigid import solver as constraint_solver
from rewax.physics.rigid.forces import applied_forces, kinematics, mjx_data, tree_parameters
from rewax.physics.rigid.kinematic_tree import JointType
from rewax.physics.rigid.kinematics import integrate
from rewax.physics.rigid.model import RigidModel, RigidState, check_state
from rewax.physics.rigid.small_products import cross, dot, rotate
from rewax.physics.rigid.stepping import checked_inputs, forgotten
from rewax.physics.rigid.tree_dynamics import inverse_dynamics, mass_matrix
from rewax.types import Array


def step_with_stale_mass(
    model: RigidModel, state: RigidState, ctrl: Array | None = None, *, num_substeps: int = 1
) -> RigidState:
    """The state ``num_substeps`` substeps later, all with the mass matrix of the first.

    Args:
      model: one tree on a free joint under a penalty law, without damping of joints and without activations.
      state: initial state.
      ctrl: constant controls, shape (num_actuators,); None: zero.
      num_substeps: number of substeps, at least 1.

    Returns:
      The final state. For one substep it differs from that of ``stepping.step`` by the order dt^2, because the twist is
      constant while the body moves.

    Gradient: exact for the discrete map, forward and reverse. Zero through ``qacc``.
    Source: Warp's ``FeatherstoneIntegrator``. Any fixed point gives the same motion as the world's origin. Here it is
      the initial position of the free body, which keeps rounding errors small.

    Raises:
      ValueError: the model is not such a tree, or an argument is illegal.
    """
    check_state(model, state)
    check_can_keep_mass(model)
    ctrl, _ = checked_inputs(model, ctrl, None, num_substeps, state.qpos.dtype)
    origin, mass = state.qpos[:3], _mass_of_twists(model, state.qpos)

    def substep(state: RigidState, _: None) -> tuple[RigidState, None]:
        return _substep(model, mass, origin, state, ctrl), None

    return jax.lax.scan(substep, forgotten(state), None, length=num_substeps)[0]


def check_can_keep_mass(model: RigidModel) -> None:
    """Raises ValueError unless ``step_with_stale_mass`` can move the model."""
    mj, kinds = model.static.mj, model.static.topology.joint_type
    free = np.flatnonzero(kinds == JointType.FREE)
    if model.penalty is None or model.static.has_damping or mj.na or list(free) != [0] or JointType.BALL in kinds:
        raise ValueError(
            "a mass matrix is kept for models with a penalty law and one free joint, the first, and without ball "
            "joints, damping of joints and activations: use rigid.step for others"
        )


def _mass(model: RigidModel, qpos: Array) -> Array:
    """Mass matrix in the coordinates of ``_twist``, about the free body's position, shape (num_dofs, num_dofs)."""
    with jax.default_matmul_precision("highest"):
        mass = mass_matrix(model.static.topology, tree_parameters(model), kinematics(model, qpos))
        turn = _rotation(qpos).T
        rows = jnp.concatenate([mass[:, :3], dot(mass[:, 3:6], turn), mass[:, 6:]], axis=1)
        return jnp.concatenate([rows[:3], dot(turn.T, rows[3:6]), rows[6:]])


_mass_of_twists = interpreted(_mass)


def _rotation(qpos: Array) -> Array:
    return quaternion_to_matrix(normalized(qpos[3:7]))


def _twist(qpos: Array, qvel: Array, origin: Array) -> Array:
    """Velocity of the free body's point at the origin, angular velocity in world axes, rates of the other joints."""
    spin = rotate(_rotation(qpos), qvel[3:6])
    return jnp.concatenate([qvel[:3] - cross(spin, qpos[:3] - origin), spin, qvel[6:]])


def _velocities(qpos: Array, twist: Array, origin: Array) -> Array:
    """The inverse of ``_twist``: MuJoCo's velocities, whose angular part is in the body's frame."""
    spin = twist[3:6]
    linear = twist[:3] + cross(spin, qpos[:3] - origin)
    return jnp.concatenate([linear, rotate(_rotation(qpos).T, spin), twist[6:]])


def _balance(model: RigidModel, origin: Array, state: RigidState, ctrl: Array) -> tuple[Array, Array]:
    """Generalized force that changes the twist (applied minus bias forces), and the twist, shape (num_dofs,) each."""
    topology, parameters = model.static.topology, tree_parameters(model)
    kin = kinematics(model, state.qpos)
    m, d = mjx_data(model, kin, state, ctrl)
    applied, _ = applied_forces(model, kin, m, d, jnp.zeros((model.num_bodies, 6), state.qpos.dtype))
    twist = _twist(state.qpos, state.qvel, origin)
    # While the twist is constant the body's own origin accelerates by omega x v.
    steady = jnp.concatenate([cross(twist[3:6], state.qvel[:3]), jnp.zeros(model.num_dofs - 3, twist.dtype)])
    force = applied - inverse_dynamics(topology, parameters, kin, state.qvel, steady, model.gravity)
    torque = rotate(_rotation(state.qpos), force[3:6]) + cross(state.qpos[:3] - origin, force[:3])
    return jnp.concatenate([force[:3], torque, force[6:]]), twist


def _move(model: RigidModel, origin: Array, state: RigidState, twist: Array) -> RigidState:
    """The state after a substep with a constant twist."""
    qpos = integrate(model.static.topology, state.qpos, _velocities(state.qpos, twist, origin), model.dt)
    return state.replace(qpos=qpos, qvel=_velocities(qpos, twist, origin))


def _advance(model: RigidModel, mass: Array, origin: Array, state: RigidState, ctrl: Array) -> RigidState:
    with jax.default_matmul_precision("highest"):
        force, twist = _balance(model, origin, state, ctrl)
        change = constraint_solver.solve_spd(mass, force)
        return _move(model, origin, state, twist + model.dt * change).replace(qacc=change)


def _advance_derivative(
    known: RigidState, model: RigidModel, mass: Array, origin: Array, state: RigidState, ctrl: Array
) -> RigidState:
    """``known``, the result of ``_advance``, with its derivative from the balance ``mass change = force``."""
    with jax.default_matmul_precision("highest"):
        force, twist = _balance(model, origin, state, ctrl)
        change = jax.lax.stop_gradient(known.qacc)
        change = change - constraint_solver.implicit_correction(mass, dot(mass, change) - force)
        return _move(model, origin, state, twist + model.dt * change).replace(qacc=jax.lax.stop_gradient(known.qacc))


_substep = interpreted(_advance, derivative_of=_advance_derivative)

__all__ = ["check_can_keep_mass", "step_with_stale_mass"]
