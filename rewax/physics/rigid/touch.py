"""Contacts of articulated bodies as their bodies feel them: ``step`` with forces and torques on patches."""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.machine import interpreted
from rewax.physics.contact.patches import accumulated, check_patches, felt, no_touch
from rewax.physics.numerics.components import split_vector
from rewax.physics.numerics.pose import Pose
from rewax.physics.rigid import solver as constraint_solver
from rewax.physics.rigid.forces import (
    applied_forces,
    kinematics,
    mjx_data,
    rows_and_contacts,
    spring_forces,
    tree_parameters,
)
from rewax.physics.rigid.kinematics import body_velocities
from rewax.physics.rigid.mjx_access import mjx
from rewax.physics.rigid.model import RigidModel, RigidState, check_state
from rewax.physics.rigid.stepping import checked_inputs, forgotten, rates
from rewax.physics.rigid.tree_dynamics import inverse_dynamics, mass_matrix
from rewax.types import Array


def step_with_touch(
    model: RigidModel,
    state: RigidState,
    ctrl: Array | None = None,
    *,
    patches: Any,
    wrenches: Array | None = None,
    num_substeps: int = 1,
) -> tuple[RigidState, Any]:
    """``step``, and the mean force and torque of contacts on patches of bodies.

    Args:
      model, state, ctrl, wrenches, num_substeps: as for ``step``.
      patches: ``contact.Patches``, or a dict of them. Body 0 is the world: it feels what rests on fixed geoms.

    Returns:
      The state of ``step``. Force [N] and torque [N m] on each patch, a ``contact.Wrench`` of arrays (num_patches, 3)
      for each ``Patches``: world axes, torque about the origin of the body's frame, averaged over the substeps. Forces
      of limits, actuators and equalities are no contacts.

    Gradient: exact for the discrete map, forward and reverse, as for ``step``. None by which patch a contact is nearest
      to.
    """
    check_state(model, state)
    ctrl, wrenches = checked_inputs(model, ctrl, wrenches, num_substeps, state.qpos.dtype)
    check_patches(patches, model.num_bodies)

    def substep(carry: tuple[RigidState, Any], _: None) -> tuple[tuple[RigidState, Any], None]:
        state, total = carry
        after = rates(model, state, ctrl, wrenches)[1]
        contacts = felt_contacts(model, state, after.qacc, ctrl, wrenches, patches)
        return (after, accumulated(total, contacts, 1.0 / num_substeps)), None

    start = (forgotten(state), no_touch(patches, state.qpos))
    return jax.lax.scan(substep, start, None, length=num_substeps)[0]


def felt_contacts(model: RigidModel, state: RigidState, qacc: Array, ctrl: Array, wrenches: Array, patches: Any) -> Any:
    """Force and torque of contacts on patches of bodies within one substep; see ``step_with_touch``.

    Args:
      model, ctrl, wrenches: as for ``step``, but not None.
      state: at the substep's beginning.
      qacc: joint accelerations of the substep, the ``qacc`` of the state after it.
      patches: ``contact.Patches``, or a dict of them.

    Gradient: exact by state, controls, wrenches and parameters: it includes that of ``qacc``.
    """
    if not model.static.has_contacts:
        return no_touch(patches, state.qpos)
    return _felt(model, state, jax.lax.stop_gradient(qacc), ctrl, wrenches, patches)


class _PointForces(NamedTuple):
    """Forces and torques of n contacts on the second bodies, then on the first."""

    body: Array
    point: Array
    force: Array
    torque: Array | None


def _value(model: RigidModel, state: RigidState, qacc: Array, ctrl: Array, wrenches: Array, patches: Any) -> Any:
    return _contacts(model, state, qacc, ctrl, wrenches, patches, derivative=False)


def _derivative(
    known: Any, model: RigidModel, state: RigidState, qacc: Array, ctrl: Array, wrenches: Array, patches: Any
) -> Any:
    """``_value``, with the derivative of ``qacc`` from the balance of forces, as in ``stepping``."""
    del known
    return _contacts(model, state, qacc, ctrl, wrenches, patches, derivative=True)


_felt = interpreted(_value, derivative_of=_derivative)


def _contacts(
    model: RigidModel,
    state: RigidState,
    qacc: Array,
    ctrl: Array,
    wrenches: Array,
    patches: Any,
    *,
    derivative: bool,
) -> Any:
    with jax.default_matmul_precision("highest"):
        topology, parameters = model.static.topology, tree_parameters(model)
        kin = kinematics(model, state.qpos)
        m, d = mjx_data(model, kin, state, ctrl)
        if model.penalty is not None:
            twist = body_velocities(topology, kin, state.qvel)
            found = _PointForces(*spring_forces(model, model.penalty, kin, m, d, twist)[:3], None)
        else:
            rows, contact = rows_and_contacts(model, kin, m, d)
            assert contact is not None, "a model without contacts feels nothing"
            if derivative:
                applied, _ = applied_forces(model, kin, m, d, wrenches)
                mass = mass_matrix(topology, *jax.lax.stop_gradient((parameters, kin)))
                matrix = constraint_solver.curvature(mass, jax.lax.stop_gradient(rows), qacc)
                needed = inverse_dynamics(topology, parameters, kin, state.qvel, qacc, model.gravity)
                missing = needed - applied - rows.jacobian.T @ constraint_solver.row_forces(rows, qacc)
                qacc = qacc - constraint_solver.implicit_correction(matrix, missing)
            found = _of_rows(model, contact, constraint_solver.row_forces(rows, qacc))
        torque = () if found.torque is None else [(found.body, split_vector(found.torque))]
        return felt(
            patches,
            split_vector(found.point),
            [(found.body, split_vector(found.force))],
            Pose(kin.position, kin.rotation),
            turned_by=torque,
        )


def _of_rows(model: RigidModel, contact: mjx.Contact, forces: Array) -> _PointForces:
    """Forces of contacts from those of all constraint rows, of which they are the last.

    A contact without friction has one row along its normal. One of ``condim`` d has d - 1 pairs of rows, the edges
    normal + mu_k axis_k and normal - mu_k axis_k of its pyramid. Axes 1 and 2 are tangents, 3 to 5 rotations about the
    three axes of the frame.

    Source: MuJoCo's ``mju_decodePyramid``.
    """
    dims = np.asarray(contact.dim)
    first = len(forces) - int(sum(1 if d == 1 else 2 * (d - 1) for d in dims))
    parts = []
    for dim in np.unique(dims):
        which = np.flatnonzero(dims == dim)
        size = 1 if dim == 1 else 2 * (dim - 1)
        edges = forces[first : first + len(which) * size].reshape(len(which), size)
        first += len(which) * size
        local = [jnp.sum(edges, axis=1)]
        local += [(edges[:, 2 * k] - edges[:, 2 * k + 1]) * contact.friction[which, k] for k in range(dim - 1)]
        local += [jnp.zeros_like(local[0])] * (6 - dim)
        parts.append(jnp.stack(local, axis=1))
    local = jnp.concatenate(parts)
    force, torque = (
        sum(part[:, k, None] * contact.frame[:, k] for k in range(3)) for part in (local[:, :3], local[:, 3:])
    )
    bodies = jnp.asarray(model.static.mj.geom_bodyid)[contact.geom]
    return _PointForces(
        jnp.concatenate([bodies[:, 1], bodies[:, 0]]),
        jnp.concatenate([contact.pos, contact.pos]),
        jnp.concatenate([force, -force]),
        jnp.concatenate([torque, -torque]) if np.any(dims > 3) else None,
    )


__all__ = ["felt_contacts", "step_with_touch"]
