"""Forces of actuators: MJX's, but for limits, the activation of muscles, and servos of ball joints.

At a limit MJX's derivatives are half of what they should be, or not finite. Those of muscles overflow in single
precision. MJX takes a servo with a filter the long way around, MuJoCo 4.0 the short one.
"""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.clipping import clipped
from rewax.physics.rigid.mjcf import is_disabled
from rewax.physics.rigid.mjx_access import (
    actuator_moments,
    actuator_velocities,
    mjx,
    mujoco,
    with_actuator_velocities,
)
from rewax.physics.rigid.model import RigidModel
from rewax.physics.rigid.small_products import dot
from rewax.types import Array

ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
"""Transmissions of actuators that act on one joint."""
_INTEGRATOR, _MUSCLE = int(mujoco.mjtDyn.mjDYN_INTEGRATOR), int(mujoco.mjtDyn.mjDYN_MUSCLE)
_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
_FORCE_LIMITS = ("actuator_forcelimited", "tendon_actfrclimited", "jnt_actfrclimited")


def actuated(model: RigidModel, m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """``mjx.fwd_actuation`` with exact derivatives at limits of controls and of forces.

    The activations of ``d`` become those that the forces had: set points of ball joints are turned by whole turns to be
    nearest to the joint.

    Gradient: exact, zero beyond a limit and that of the inside at it. MJX's is half of that, and not finite for a
    limited tendon at zero force. Source of the limits' order: MuJoCo, ``mj_fwdActuation``.
    """
    mj = model.static.mj
    if not mj.nu or is_disabled(mj, "ACTUATION"):
        return mjx.fwd_actuation(m, d)
    d = _without_force_limits(mj, m, d)
    if not any(np.any(getattr(mj, name)) for name in _FORCE_LIMITS):
        return d
    force = _limited(mj, m, d.actuator_force)
    total = actuator_moments(d).T @ force
    if np.any(mj.jnt_actgravcomp):
        total = total + d.qfrc_gravcomp * mj.jnt_actgravcomp[mj.dof_jntid]
    low, high = m.jnt_actfrcrange[mj.dof_jntid].T
    total = jnp.where(mj.jnt_actfrclimited[mj.dof_jntid] != 0, clipped(total, low, high), total)
    return d.replace(actuator_force=force, qfrc_actuator=total)


def actuator_damping(model: RigidModel, m: mjx.Model, d: mjx.Data) -> Array:
    """Matrix -d force / d velocity of the actuators, shape (num_dofs, num_dofs), where ``d`` has their moments.

    As in MuJoCo without that of actuators at their ``forcerange``, of those of a tendon at its ``actuatorfrcrange``,
    and of a joint's own at its ``actuatorfrcrange``.

    Gradient: exact.
    """
    mj = model.static.mj

    def pull(velocity: Array) -> Array:
        return _without_force_limits(mj, m, with_actuator_velocities(d, velocity)).actuator_force

    moment, velocity = actuator_moments(d), actuator_velocities(d)
    # Each force depends on its own velocity.
    force, slope = jax.jvp(pull, (velocity,), (jnp.ones_like(velocity),))
    if np.any(mj.tendon_actfrclimited):
        pulls, total, low, high = _tendon_forces(mj, m, force)
        slope = jnp.where(pulls.T @ ((total <= low) | (total >= high)) > 0, 0.0, slope)
    force = _limited(mj, m, force)
    if np.any(mj.actuator_forcelimited):
        low, high = m.actuator_forcerange.T
        slope = jnp.where((mj.actuator_forcelimited != 0) & ((force <= low) | (force >= high)), 0.0, slope)
    if np.any(mj.jnt_actfrclimited):
        total, (low, high) = dot(moment.T, force), mj.jnt_actfrcrange[mj.dof_jntid].T
        clamped = (mj.jnt_actfrclimited[mj.dof_jntid] != 0) & ((total <= low) | (total >= high))
        own = np.isin(mj.actuator_trntype, ON_JOINT)
        moment = jnp.where(clamped & own[:, None], 0.0, moment)
    return -dot(moment.T, slope[:, None] * moment)


def _without_force_limits(mj: mujoco.MjModel, m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """``mjx.fwd_actuation`` with limits of controls only, and with our own set points and rates of muscles."""
    if np.any(mj.actuator_ctrllimited) and not is_disabled(mj, "CLAMPCTRL"):
        low, high = m.actuator_ctrlrange.T
        ctrl = jnp.where(mj.actuator_ctrllimited != 0, clipped(d.ctrl, low, high), d.ctrl)
        unclamped = m.opt.disableflags | int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
        m, d = m.replace(opt=m.opt.replace(disableflags=unclamped)), d.replace(ctrl=ctrl)
    m = m.replace(**{name: np.zeros_like(getattr(m, name)) for name in _FORCE_LIMITS})
    d = _with_nearest_set_points(mj, m, d)
    muscles = np.flatnonzero(mj.actuator_dyntype == _MUSCLE)
    if len(muscles) == 0:
        return mjx.fwd_actuation(m, d)
    kinds = np.where(mj.actuator_dyntype == _MUSCLE, _INTEGRATOR, m.actuator_dyntype)  # which has an activation, too
    own = mj.actuator_actadr[muscles]
    rates = muscle_rates(d.ctrl[muscles], d.act[own], m.actuator_dynprm[muscles])
    d = mjx.fwd_actuation(m.replace(actuator_dyntype=kinds), d)
    return d.replace(act_dot=d.act_dot.at[own].set(rates))


def next_activations(model: RigidModel, m: mjx.Model, d: mjx.Data) -> Array:
    """Activations after a substep, from the ``act`` and ``act_dot`` of ``actuated``, shape (num_activations,).

    Gradient: exact, as in ``actuated``. Source: MuJoCo, ``mj_nextActivation``.
    """
    mj = model.static.mj
    if not mj.na:
        return d.act
    actuator = _of_activations(mj)
    exact = mj.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_FILTEREXACT
    tau = np.maximum(mj.actuator_dynprm[actuator, 0], mujoco.mjMINVAL)
    span = np.where(exact, tau * -np.expm1(-mj.opt.timestep / tau), mj.opt.timestep)
    limited = mj.actuator_actlimited[actuator].astype(bool)
    low, high = (np.where(limited, mj.actuator_actrange[actuator, i], (-np.inf, np.inf)[i]) for i in (0, 1))
    low, high, span = (jnp.asarray(a, d.act.dtype) for a in (low, high, span))
    turning = np.flatnonzero(_turns(mj)[actuator])
    act = d.act + span * d.act_dot
    if len(turning):
        own = actuator[turning]
        act = act.at[turning].set(_nearest(act[turning], d.actuator_length[own], _periods(m)[own]))
    return clipped(act, low, high)


def _of_activations(mj: mujoco.MjModel) -> np.ndarray:
    """The actuator of each activation, shape (num_activations,)."""
    return np.repeat(np.arange(mj.nu), np.maximum(mj.actuator_actnum, 0))


def _turns(mj: mujoco.MjModel) -> np.ndarray:
    """Which actuators are servos of ball joints, whose set points are angles, shape (num_actuators,), bool."""
    if not mj.njnt:
        return np.zeros(mj.nu, bool)
    ball = mj.jnt_type[np.clip(mj.actuator_trnid[:, 0], 0, mj.njnt - 1)] == int(mujoco.mjtJoint.mjJNT_BALL)
    fixed = mj.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = mj.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    servo = fixed & affine & (mj.actuator_gainprm[:, 0] == -mj.actuator_biasprm[:, 1])
    geared = np.any(mj.actuator_gear[:, :3] != 0, axis=1)
    return ball & geared & np.isin(mj.actuator_trntype, ON_JOINT) & servo & (mj.actuator_dyntype != _MUSCLE)


def _periods(m: mjx.Model) -> Array:
    """Lengths of whole turns of ball joints [1], shape (num_actuators,)."""
    return 2.0 * jnp.pi * jnp.sqrt(jnp.sum(m.actuator_gear[:, :3] ** 2, axis=1))


def _nearest(value: Array, goal: Array, period: Array) -> Array:
    """The value plus whole periods that is nearest to the goal. Gradient: that of the value."""
    turns = jax.lax.stop_gradient((value - goal) / period)
    return value - period * jnp.sign(turns) * jnp.floor(jnp.abs(turns) + 0.5)


def _with_nearest_set_points(mj: mujoco.MjModel, m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """Activations nearest to their ball joint, and controls nearest to what follows them: activation or joint."""
    turns = _turns(mj)
    if not np.any(turns):
        return d
    period, last = _periods(m), mj.actuator_actadr + mj.actuator_actnum - 1
    stored, ctrl, act = np.flatnonzero(turns & (mj.actuator_actadr >= 0)), d.ctrl, d.act
    if len(stored):
        own = last[stored]
        act = act.at[own].set(_nearest(act[own], d.actuator_length[stored], period[stored]))
    goal = d.actuator_length
    filtered, direct = (np.flatnonzero(turns & kind) for kind in (np.isin(mj.actuator_dyntype, _FILTERS), last < 0))
    if len(filtered):
        goal = goal.at[filtered].set(act[last[filtered]])
    followed = np.concatenate([filtered, direct])
    ctrl = ctrl.at[followed].set(_nearest(ctrl[followed], goal[followed], period[followed]))
    return d.replace(ctrl=ctrl, act=act)


def muscle_rates(ctrl: Array, act: Array, parameters: Array) -> Array:
    """Rates of change of muscles' activations [1/s], shape (n,).

    Args:
      ctrl, act: excitations and activations [-], shape (n,).
      parameters: time constants of activation and of deactivation [s], and the width of the transition between them,
        shape (n, 3 or more).

    Gradient: exact; at the ends of [0, 1] that of the inside, and for equal excitation and activation that of a larger
      excitation. Source: MuJoCo, ``mju_muscleDynamics`` (Millard et al. 2013).
    """
    rising, falling, width = parameters[:, 0], parameters[:, 1], parameters[:, 2]
    excess, bounded = clipped(ctrl, 0.0, 1.0) - act, clipped(act, 0.0, 1.0)
    rising, falling = rising * (0.5 + 1.5 * bounded), falling / (0.5 + 1.5 * bounded)
    is_smooth = width >= mujoco.mjMINVAL
    x = clipped(excess / jnp.where(is_smooth, width, 1.0) + 0.5, 0.0, 1.0)
    share = x * x * x * (x * (6.0 * x - 15.0) + 10.0)
    hard = jnp.where(excess >= 0, rising, falling)
    duration = jnp.where(is_smooth, falling + (rising - falling) * share, hard)
    return excess / jnp.maximum(mujoco.mjMINVAL, duration)


def _limited(mj: mujoco.MjModel, m: mjx.Model, force: Array) -> Array:
    """Forces of the actuators within the limits of their tendons, then their own, shape (num_actuators,).

    The forces of all actuators of a tendon are reduced by one factor, so that their sum stays within its limit.
    """
    if np.any(mj.tendon_actfrclimited):
        pulls, total, low, high = _tendon_forces(mj, m, force)
        beyond = (total < low) | (total > high)
        share = jnp.where(beyond, clipped(total, low, high) / jnp.where(beyond, total, 1.0), 1.0)
        force = force * (1.0 + pulls.T @ (share - 1.0))
    if np.any(mj.actuator_forcelimited):
        low, high = m.actuator_forcerange.T
        force = jnp.where(mj.actuator_forcelimited != 0, clipped(force, low, high), force)
    return force


def _tendon_forces(mj: mujoco.MjModel, m: mjx.Model, force: Array) -> tuple[np.ndarray, Array, Array, Array]:
    """Of the limited tendons: which actuators pull at them, shape (limited, num_actuators), their sum, its bounds."""
    limited = np.flatnonzero(mj.tendon_actfrclimited)
    on_tendon = mj.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    pulls = (on_tendon & (mj.actuator_trnid[:, 0] == limited[:, None])).astype(force.dtype)
    return pulls, pulls @ force, *m.tendon_actfrcrange[limited].T


__all__ = ["ON_JOINT", "actuated", "actuator_damping", "muscle_rates", "next_activations"]
