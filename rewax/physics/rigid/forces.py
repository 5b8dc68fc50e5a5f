"""Forces on articulated rigid bodies: contacts, limits, actuators and springs, from MJX and the penalty law."""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.structural import structural_zeros
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.rotations import (
    matrix_to_quaternion,
    quaternion_product,
    quaternion_to_matrix,
    rotation_vector,
)
from rewax.physics.rigid.actuation import ON_JOINT, actuated, actuator_damping, next_activations
from rewax.physics.rigid.box_box import box_box
from rewax.physics.rigid.capsules import capsule_capsule
from rewax.physics.rigid.collide import collide
from rewax.physics.rigid.connect import connect_drifts
from rewax.physics.rigid.kinematic_tree import TreeParameters
from rewax.physics.rigid.kinematics import Kinematics, body_velocities, generalized_forces
from rewax.physics.rigid.kinematics import kinematics as tree_kinematics
from rewax.physics.rigid.mjcf import is_disabled
from rewax.physics.rigid.mjx_access import (
    actuator_moments,
    constraint_arrays,
    mjx,
    mujoco,
    num_bounded_rows,
    tendon,
    tendon_jacobian,
    with_actuator_velocities,
    with_tendon_velocities,
)
from rewax.physics.rigid.model import RigidModel, RigidState
from rewax.physics.rigid.small_products import compose, cross, dot, rotate, scatter, select
from rewax.physics.rigid.solver import Rows
from rewax.physics.rigid.sphere_box import sphere_box
from rewax.physics.rigid.spring_contacts import Penalty, PointForces, limit_forces, point_forces
from rewax.physics.rigid.weld import weld_drifts
from rewax.types import Array

LEAST_FRICTION = 1e-2
"""Coefficient of friction below which single precision regularises a contact like one with this coefficient.

With a coefficient mu, MuJoCo makes the rows of a contact 1 / mu^2 times as stiff, and 1e10 times the mass is beyond
float32. The force of friction still has mu."""


def kinematics(model: RigidModel, qpos: Array) -> Kinematics:
    """``kinematics.kinematics`` of a model."""
    return tree_kinematics(model.static.topology, tree_parameters(model), qpos)


def tree_parameters(model: RigidModel) -> TreeParameters:
    """The model's parameters that its tree needs."""
    return TreeParameters(**{name: model.parameters[name] for name in TreeParameters._fields})


def attached(kin: Kinematics, body: np.ndarray, position: Array, quaternion: Array) -> Pose:
    """World poses of frames that are fixed to bodies."""
    frames = jnp.concatenate([kin.rotation, kin.position[:, :, None]], axis=-1)
    frame = structural_zeros(select(body, frames))
    rotation = compose(frame[:, :, :3], quaternion_to_matrix(quaternion))
    return Pose(frame[:, :, 3] + rotate(frame[:, :, :3], position), rotation)


def mjx_data(model: RigidModel, kin: Kinematics, state: RigidState, ctrl: Array) -> tuple[mjx.Model, mjx.Data]:
    """MJX's model and data at a state, with all fields that MJX's collisions, constraints and forces read."""
    static, parameters = model.static, dict(model.parameters)
    for name in ("jnt_solimp", "geom_solimp", "pair_solimp"):
        # The derivative by the exponent of the impedance contains log(0), so only the other entries have a gradient.
        value = parameters[name]
        parameters[name] = jnp.concatenate([value[:, :4], jax.lax.stop_gradient(value[:, 4:])], axis=1)
    m = static.mjx.replace(**parameters, opt=static.mjx.opt.replace(gravity=model.gravity))
    d = static.data.replace(
        qpos=state.qpos,
        qvel=state.qvel,
        act=state.act,
        ctrl=ctrl,
        xpos=kin.position,
        xmat=kin.rotation,
        xipos=kin.com,
        ximat=kin.inertia_rotation,
        subtree_com=kin.subtree_com,
        cdof=kin.axes,
    )
    if static.has_welds:
        d = d.replace(xquat=matrix_to_quaternion(kin.rotation))
    geoms = static.moving_geoms
    if 0 < len(geoms) < static.mj.ngeom:
        pose = attached(
            kin, static.mj.geom_bodyid[geoms], parameters["geom_pos"][geoms], parameters["geom_quat"][geoms]
        )
        d = d.replace(
            geom_xpos=d.geom_xpos.at[geoms].set(pose.position, unique_indices=True),
            geom_xmat=d.geom_xmat.at[geoms].set(pose.rotation, unique_indices=True),
        )
    elif len(geoms):
        pose = attached(kin, static.mj.geom_bodyid, parameters["geom_pos"], parameters["geom_quat"])
        d = d.replace(geom_xpos=pose.position, geom_xmat=pose.rotation)
    if static.mj.nsite:
        pose = attached(kin, static.mj.site_bodyid, m.site_pos, m.site_quat)
        d = d.replace(site_xpos=pose.position, site_xmat=pose.rotation)
    return m, d


def applied_forces(
    model: RigidModel, kin: Kinematics, m: mjx.Model, d: mjx.Data, wrenches: Array
) -> tuple[Array, Array]:
    """Generalized forces of actuators, springs, dampers and wrenches, shape (num_dofs,); ``act`` after a substep."""
    topology = model.static.topology
    twist = body_velocities(topology, kin, d.qvel)
    springless = m.replace(jnt_stiffness=jnp.zeros_like(m.jnt_stiffness))
    d = actuated(model, m, mjx.passive(springless, _drives(model, m, d.replace(cvel=twist))))
    arm = kin.com - kin.tree_com
    torque = wrenches[:, 3:] + cross(arm, wrenches[:, :3])
    external = jnp.concatenate([torque, wrenches[:, :3]], axis=-1)
    if model.penalty is not None:
        external = external + _contact_wrenches(model, model.penalty, kin, m, d, twist)
    force = _spring_forces(model, d.qpos) + d.qfrc_passive + d.qfrc_actuator
    force = force + generalized_forces(topology, kin, external)
    if model.penalty is not None:
        mj = model.static.mj
        joint = np.flatnonzero(mj.jnt_limited)
        position, dof = mj.jnt_qposadr[joint], mj.jnt_dofadr[joint]
        limits = model.parameters["jnt_range"][joint] + model.parameters["jnt_margin"][joint, None] * np.array([1, -1])
        found = limit_forces(model.penalty, limits, d.qpos[position], d.qvel[dof])
        force = force + scatter(dof, found, model.num_dofs)
    return force, next_activations(model, m, d)


def velocity_damping(model: RigidModel, m: mjx.Model, d: mjx.Data) -> Array:
    """Damping matrix -d force / d velocity, symmetric, shape (num_dofs, num_dofs).

    As in MuJoCo's integrator implicitfast it includes joints, tendons and actuators, but not the Coriolis terms, nor
    damping between degrees of freedom of which neither moves the other, nor a joint's own actuators
    where its ``actuatorfrcrange`` limits their force.

    Gradient: exact.
    """
    d = _drives(model, m, d)
    mj = model.static.mj
    damping = jnp.zeros((model.num_dofs, model.num_dofs), d.qvel.dtype)
    if mj.nu and not is_disabled(mj, "ACTUATION"):
        damping += actuator_damping(model, m, d)
    if mj.ntendon:
        jacobian = tendon_jacobian(d)
        damping += dot(jacobian.T, m.tendon_damping[:, None] * jacobian)
    carries = model.static.topology.moves[mj.dof_bodyid]
    return jnp.diag(model.parameters["dof_damping"]) + np.maximum(carries, carries.T).astype(damping.dtype) * damping


def _drives(model: RigidModel, m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """Lengths, moment arms and velocities of tendons and actuators."""
    if model.static.mj.ntendon:
        d = tendon(m, d)
    d = mjx.transmission(m, d)
    d = d.replace(actuator_length=_actuator_lengths(model, m, d))
    d = with_actuator_velocities(d, dot(actuator_moments(d), d.qvel))
    return with_tendon_velocities(d, dot(tendon_jacobian(d), d.qvel))


def _spring_forces(model: RigidModel, qpos: Array) -> Array:
    """Forces of the joints' springs, shape (num_dofs,). MJX's lack a derivative for a ball joint at its reference."""
    mj, rest = model.static.mj, model.parameters["qpos_spring"]
    free, ball = (mj.jnt_type == int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL"))
    simple = ~free & ~ball

    def joined(simple_start: np.ndarray, free_start: np.ndarray) -> np.ndarray:
        return np.concatenate([simple_start, (free_start[:, None] + np.arange(3)).ravel()])

    index = joined(mj.jnt_qposadr[simple], mj.jnt_qposadr[free])
    dof = joined(mj.jnt_dofadr[simple], mj.jnt_dofadr[free])
    displacement = scatter(dof, qpos[index] - rest[index], model.num_dofs)
    if np.any(free | ball):
        index = np.concatenate([mj.jnt_qposadr[free] + 3, mj.jnt_qposadr[ball]])[:, None] + np.arange(4)
        dof = np.concatenate([mj.jnt_dofadr[free] + 3, mj.jnt_dofadr[ball]])[:, None] + np.arange(3)
        back = rest[index] * np.array([1.0, -1.0, -1.0, -1.0])
        turn = rotation_vector(quaternion_product(back, qpos[index]))
        displacement = displacement + scatter(dof.ravel(), turn.ravel(), model.num_dofs)
    return -model.parameters["jnt_stiffness"][mj.dof_jntid] * displacement


def _actuator_lengths(model: RigidModel, m: mjx.Model, d: mjx.Data) -> Array:
    """Lengths of the actuators, shape (num_actuators,). MJX's lack a derivative for ball joints."""
    mj = model.static.mj
    on_joint = np.isin(mj.actuator_trntype, ON_JOINT)
    joint = np.where(on_joint, mj.actuator_trnid[:, 0], 0)
    own = np.flatnonzero(on_joint & (mj.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_BALL)))
    if len(own) == 0:
        return d.actuator_length
    turn = rotation_vector(d.qpos[mj.jnt_qposadr[joint[own]][:, None] + np.arange(4)])
    return d.actuator_length.at[own].set(jnp.sum(turn * m.actuator_gear[own, :3], axis=-1))


class _Contacts(NamedTuple):
    """Inputs of ``spring_contacts.point_forces`` for all pairs that may touch."""

    distance: Array
    margin: Array
    point: Array
    normal: Array
    friction: Array
    geoms: Array


def contacts(model: RigidModel, m: mjx.Model, d: mjx.Data) -> _Contacts:
    """Contacts of ``collide``, then those of explicit pairs that a penalty law collides with functions of its own."""
    contact = collide(model.static.collisions, m, d)
    friction = jnp.where(np.asarray(contact.dim) > 1, contact.friction[:, 0], 0.0)
    found = [
        _Contacts(
            contact.dist, contact.includemargin, contact.pos, contact.frame[:, 0], friction, jnp.asarray(contact.geom)
        )
    ]
    size, xpos, xmat = m.geom_size, d.geom_xpos, d.geom_xmat
    own, sphere, box = model.static.sphere_boxes
    if len(own):
        met = sphere_box(xpos[sphere], size[sphere, 0], xpos[box], xmat[box], size[box])
        found.append(_own_contacts(model, own, (sphere, box), met))
    own, first, second = model.static.capsules
    if len(own):
        lines = jnp.concatenate([xpos, xmat[:, :, 2]], axis=-1)
        line, other = select(first, lines), select(second, lines)
        met = capsule_capsule(line[:, :3], line[:, 3:], size[first], other[:, :3], other[:, 3:], size[second])
        found.append(_own_contacts(model, own, (first, second), met))
    own, first, second = model.static.boxes
    if len(own):
        frames = jnp.concatenate([xpos[:, :, None], xmat], axis=-1)
        frame, other = select(first, frames), select(second, frames)
        box, other_box = ((f[:, :, 0], f[:, :, 1:], size[g]) for f, g in ((frame, first), (other, second)))
        found.append(_own_contacts(model, own, (first, second), box_box(*box, *other_box)))
    return jax.tree.map(lambda *a: jnp.concatenate(a), *found) if len(found) > 1 else found[0]


def _own_contacts(
    model: RigidModel, pairs: np.ndarray, geoms: tuple[np.ndarray, np.ndarray], met: tuple[Array, Array, Array]
) -> _Contacts:
    """Contacts from distances, points and normals, with the explicit pairs' margins and friction."""
    distance, point, normal = met
    margin, friction = (model.parameters[f"pair_{name}"][pairs] for name in ("margin", "friction"))
    friction = jnp.where(model.static.mj.pair_dim[pairs] > 1, friction[:, 0], 0.0)
    return _Contacts(distance, margin, point, normal, friction, jnp.asarray(np.stack(geoms, axis=1)))


def _contact_wrenches(
    model: RigidModel, penalty: Penalty, kin: Kinematics, m: mjx.Model, d: mjx.Data, twist: Array
) -> Array:
    """Wrenches of all contacts on all bodies under the penalty law, shape (num_bodies, 6)."""
    if not model.static.has_contacts:
        return jnp.zeros_like(twist)
    return spring_forces(model, penalty, kin, m, d, twist).wrenches()


def spring_forces(
    model: RigidModel, penalty: Penalty, kin: Kinematics, m: mjx.Model, d: mjx.Data, twist: Array
) -> PointForces:
    """Forces of all contacts under the penalty law. Gradient: exact; see ``penalty.penalty_force``."""
    found = contacts(model, m, d)
    mj = model.static.mj
    bodies = jnp.asarray(mj.geom_bodyid)[found.geoms]
    trees = jnp.asarray(mj.body_rootid)[bodies]
    return point_forces(
        penalty,
        kin,
        twist,
        distance=found.distance - found.margin,
        point=found.point,
        normal=found.normal,
        friction=found.friction,
        bodies=bodies,
        half_gap=0.5 * found.distance,
        of_one_tree=trees[:, 0] == trees[:, 1],
    )


def constraint_rows(model: RigidModel, kin: Kinematics, m: mjx.Model, d: mjx.Data) -> Rows:
    """Constraint rows of limits, contacts, dry friction and equalities; no rows under a penalty law."""
    return rows_and_contacts(model, kin, m, d)[0]


def rows_and_contacts(model: RigidModel, kin: Kinematics, m: mjx.Model, d: mjx.Data) -> tuple[Rows, mjx.Contact | None]:
    """``constraint_rows``, and the contacts that the last of them belong to; None without contacts."""
    if model.penalty is None:
        contact = collide(model.static.collisions, m, d) if model.static.has_contacts else None
        if contact is not None:  # as in MuJoCo, whose rows contain 1 / friction
            contact = contact.replace(friction=jnp.maximum(contact.friction, mujoco.mjMINMU))
        if model.static.mj.ntendon:
            d = tendon(m, d)
        jacobian, stiffness, target, loss = constraint_arrays(m, d, contact)
        if contact is not None and stiffness.dtype == np.float32:
            stiffness = _softened(stiffness, contact)
        infinite = jnp.full_like(stiffness, jnp.inf)
        index, (num_equalities, num_dry) = np.arange(len(loss)), num_bounded_rows(d)
        equality, dry = index < num_equalities, (index >= num_equalities) & (index < num_equalities + num_dry)
        lower = jnp.where(equality, -infinite, jnp.where(dry, -loss, 0.0))
        upper = jnp.where(dry, loss, infinite)
        sites = d.site_xpos if model.static.mj.nsite else None
        held = (model.static.mj, model.static.topology, kin, d.qvel, m.eq_data, d.eq_active)
        drifts = connect_drifts(*held, sites)
        if model.static.has_welds:
            drifts = jnp.concatenate([drifts, weld_drifts(*held, d.xquat, m.site_quat, sites)])
        target = target.at[: len(drifts)].add(-drifts)
        return Rows(jacobian, stiffness, target, lower, upper), contact
    none = jnp.zeros(0, d.qpos.dtype)
    return Rows(jnp.zeros((0, model.num_dofs), d.qpos.dtype), none, none, none, none), None


def _softened(stiffness: Array, contact: mjx.Contact) -> Array:
    """Stiffness of all rows, the last of which are those of the contacts, with ``LEAST_FRICTION``."""
    dim = np.asarray(contact.dim)
    rows = np.where(dim == 1, 1, 2 * (dim - 1))
    share = jnp.where(dim == 1, 1.0, jnp.minimum(contact.friction[:, 0] / LEAST_FRICTION, 1.0) ** 2)
    first = len(stiffness) - rows.sum()
    return stiffness.at[first:].multiply(share[np.repeat(np.arange(len(dim)), rows)].astype(stiffness.dtype))
