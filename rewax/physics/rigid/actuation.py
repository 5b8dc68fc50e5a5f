"""Forces of actuators: MJX's, but for limits and the activation of muscles, whose derivatives in MJX are wrong.

At a limit they are half of what they should be, or not finite. Those of muscles overflow in single precision.
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
_FORCE_LIMITS = ("actuator_forcelimited", "tendon_actfrclimited", "jnt_actfrclimited")


def actuated(model: RigidModel, m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """``mjx.fwd_actuation`` with exact derivatives at limits of controls and of forces.

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
    """``mjx.fwd_actuation`` with limits of controls only, and with rates of muscles of our own."""
    if np.any(mj.actuator_ctrllimited) and not is_disabled(mj, "CLAMPCTRL"):
        low, high = m.actuator_ctrlrange.T
        ctrl = jnp.where(mj.actuator_ctrllimited != 0, clipped(d.ctrl, low, high), d.ctrl)
        unclamped = m.opt.disableflags | int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
        m, d = m.replace(opt=m.opt.replace(disableflags=unclamped)), d.replace(ctrl=ctrl)
    m = m.replace(**{name: np.zeros_like(getattr(m, name)) for name in _FORCE_LIMITS})
    muscles = np.flatnonzero(mj.actuator_dyntype == _MUSCLE)
    if len(muscles) == 0:
        return mjx.fwd_actuation(m, d)
    kinds = np.where(mj.actuator_dyntype == _MUSCLE, _INTEGRATOR, m.actuator_dyntype)  # which has an activation, too
    own = mj.actuator_actadr[muscles]
    rates = muscle_rates(d.ctrl[muscles], d.act[own], m.actuator_dynprm[muscles])
    d = mjx.fwd_actuation(m.replace(actuator_dyntype=kinds), d)
    return d.replace(act_dot=d.act_dot.at[own].set(rates))


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


__all__ = ["ON_JOINT", "actuated", "actuator_damping", "muscle_rates"]
