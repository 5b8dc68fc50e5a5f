"""Rows of constraints, forces of springs, dampers and actuators: against MuJoCo's own."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import rigid_models
from rigid_cases import ARM_ON_THE_FLOOR, VERSIONS, draw, home, loaded, simulate_in_c

from rewax.physics import rigid
from rewax.physics.rigid import forces as rigid_forces


def test_the_contraption_has_all_kinds_of_rows():
    """Of equalities, of dry friction of joints and tendons, of their limits, with friction in contact and without."""
    mj, _ = loaded("contraption")
    kinds = mujoco.mjtConstraint
    data = simulate_in_c(mj, home(mj), np.zeros(mj.nv), steps=1)[0]
    limited = (
        "FRICTION_DOF",
        "FRICTION_TENDON",
        "LIMIT_JOINT",
        "LIMIT_TENDON",
        "CONTACT_FRICTIONLESS",
        "CONTACT_PYRAMIDAL",
    )
    assert {"EQUALITY", *limited} == {kinds(k).name.removeprefix("mjCNSTR_") for k in data.efc_type}


def test_rows_of_constraints_are_those_of_mujoco(x64):
    """Jacobian, stiffness, target and bounds of every row that acts: equalities, dry friction, a limit, a contact."""
    mj, model = mujoco.MjModel.from_xml_string(ARM_ON_THE_FLOOR), rigid.load(ARM_ON_THE_FLOOR)
    qpos, (qvel, *_) = home(mj, b=0.3), draw(mj, speed=2.0)
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(mj, data)
    jacobian = np.zeros((data.nefc, mj.nv))
    if mujoco.mj_isSparse(mj):
        mujoco.mju_sparse2dense(jacobian, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    else:
        jacobian[:] = data.efc_J.reshape(jacobian.shape)

    kinds = np.array([mujoco.mjtConstraint(k).name.removeprefix("mjCNSTR_") for k in data.efc_type])

    @functools.partial(jax.jit, compiler_options=rigid_models.QUICK_TO_COMPILE)
    def rows_of(model, state):
        kin = rigid_forces.kinematics(model, state.qpos)
        ctrl = jnp.zeros(model.num_actuators)
        return rigid_forces.constraint_rows(model, kin, *rigid_forces.mjx_data(model, kin, state, ctrl))

    assert set(kinds) == {"EQUALITY", "FRICTION_DOF", "LIMIT_JOINT", "CONTACT_PYRAMIDAL"}
    rows = rows_of(model, rigid.initial_state(model, qpos, qvel))
    acts = np.abs(np.asarray(rows.jacobian)).sum(axis=1) > 0
    equality, dry = kinds == "EQUALITY", np.char.startswith(kinds, "FRICTION")
    lower = np.where(equality, -np.inf, np.where(dry, -data.efc_frictionloss, 0.0))
    upper = np.where(dry, data.efc_frictionloss, np.inf)
    ours = np.column_stack(
        [np.asarray(x)[acts] for x in (rows.stiffness, rows.target, rows.lower, rows.upper, rows.jacobian)]
    )
    theirs = np.column_stack([data.efc_D, data.efc_aref, lower, upper, jacobian])
    assert len(ours) == len(theirs), f"{VERSIONS} {len(ours)} rows of constraints act in MJX, {len(theirs)} in MuJoCo"

    def in_order(table):
        return table[np.lexsort(np.round(table, 6).T)]

    for name, columns in (("D", 0), ("aref", 1), ("bounds", slice(2, 4)), ("J", slice(4, None))):
        message = f"{VERSIONS} efc_{name} differs"
        np.testing.assert_allclose(in_order(ours)[:, columns], in_order(theirs)[:, columns], atol=1e-9, err_msg=message)
