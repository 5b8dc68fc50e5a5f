"""Rows of constraints, forces of springs, dampers and actuators: against MuJoCo's own."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models
from rigid_cases import ARM_ON_THE_FLOOR, VERSIONS, draw, home, loaded, simulate_in_c

from rewax.physics import rigid
from rewax.physics.rigid import forces as rigid_forces
from rewax.physics.rigid.spring_contacts import Penalty
from rewax.xla_options import unoptimised


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

    @functools.partial(jax.jit, compiler_options=unoptimised())
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


# --- Springs, dampers, actuators, wrenches ----------------------------------------------------------------------------


def applied_forces(model, state, ctrl, wrenches):
    kin = rigid_forces.kinematics(model, state.qpos)
    m, d = rigid_forces.mjx_data(model, kin, state, ctrl)
    return rigid_forces.applied_forces(model, kin, m, d, wrenches)


applied = jax.jit(applied_forces, compiler_options=unoptimised())


def test_applied_forces_are_mujocos(x64):
    """Springs, dampers, tendons, actuators of all kinds, a medium, weights held up, wrenches; activations after a step.

    In MuJoCo all forces but constraints, less what inertia takes: ``qfrc_smooth`` + ``qfrc_bias``.
    """
    mj, model = loaded("contraption")
    qpos, (qvel, ctrl, wrenches) = home(mj), draw(mj, speed=1.0)
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:], data.ctrl[:], data.xfrc_applied[:] = qpos, qvel, ctrl, wrenches
    data.act[:] = np.linspace(-0.5, 0.5, mj.na)
    mujoco.mj_forward(mj, data)
    state = rigid.initial_state(model, qpos, qvel).replace(act=jnp.asarray(data.act))
    force, act = applied(model, state, jnp.asarray(ctrl), jnp.asarray(wrenches))
    expected = data.qfrc_smooth + data.qfrc_bias
    assert np.abs(expected).min() > 1e-6
    np.testing.assert_allclose(force, expected, atol=1e-10)
    mujoco.mj_step(mj, data)
    np.testing.assert_allclose(act, data.act, atol=1e-12)


SPRINGS = """<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody>
  <body name="bob"><joint name="ball" type="ball" stiffness="0.5" damping="0"/><geom size=".1" pos="0 0 .2"/>
    <body pos="0 0 .3"><joint name="slide" type="slide" axis="0 1 0" stiffness="20" springref=".1"/><geom size=".1"/></body></body>
  <body name="cube" pos="2 0 1"><freejoint name="free"/><geom type="box" size=".1 .1 .1" mass="2"/></body>
</worldbody></mujoco>"""
REST = [1.0, 0, 0, 0, 0.1, 2.0, 0, 1, 1, 0, 0, 0]


@pytest.fixture(scope="module")
def springs():
    with jax.enable_x64(True):
        return rigid.load(SPRINGS)


def forces_at(model, qpos, wrenches=None):
    wrenches = jnp.zeros((model.num_bodies, 6)) if wrenches is None else jnp.asarray(wrenches)
    return applied(model, rigid.initial_state(model, qpos), jnp.zeros(0), wrenches)[0]


def test_springs_pull_back_by_stiffness_times_stretch(x64, springs):
    """A ball joint along its axis of turn, by the angle; a slide by the way from its spring's rest."""
    turn = np.array([0.3, -0.4, 0.5])
    angle = np.linalg.norm(turn)
    qpos = np.array(REST)
    qpos[:4] = [np.cos(angle / 2), *(np.sin(angle / 2) * turn / angle)]
    qpos[4] = 0.25
    expected = np.concatenate([-0.5 * turn, [-20.0 * 0.15], np.zeros(6)])
    np.testing.assert_allclose(forces_at(springs, qpos), expected, atol=1e-12)
    np.testing.assert_allclose(forces_at(springs, REST), 0.0, atol=1e-14)


def test_springs_have_a_derivative_at_rest(x64, springs):
    """-stiffness times half the vector part's: a turn by v is the quaternion (1, v / 2)."""

    state, none = rigid.initial_state(springs, REST), jnp.zeros((springs.num_bodies, 6))

    def at(change):
        return applied_forces(springs, state.replace(qpos=state.qpos.at[1:5].add(change)), jnp.zeros(0), none)[0]

    expected = np.zeros((10, 4))
    expected[:3, :3], expected[3, 3] = -0.5 * 2.0 * np.eye(3), -20.0
    both = jax.jit(lambda change: (jax.jacfwd(at)(change), jax.jacrev(at)(change)), compiler_options=unoptimised())
    for slopes in both(jnp.zeros(4)):
        np.testing.assert_allclose(slopes, expected, atol=1e-12)


def test_wrenches_act_at_the_centre_of_mass_in_world_axes(x64, springs):
    """Force first, then torque; the free joint's torque is in the body's frame: here turned by a quarter about z."""
    half = np.sqrt(0.5)
    qpos = np.array(REST)
    qpos[8:] = [half, 0, 0, half]
    wrenches = np.zeros((springs.num_bodies, 6))
    wrenches[springs.body("cube")] = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    expected = np.concatenate([np.zeros(4), [1.0, 2.0, 3.0], [0.2, -0.1, 0.3]])
    np.testing.assert_allclose(forces_at(springs, qpos, wrenches), expected, atol=1e-12)


def test_a_force_beside_the_joint_turns_it(x64, springs):
    """f at the centre of mass of the bob, 0.2 above the ball joint: torque r x f."""
    wrenches = np.zeros((springs.num_bodies, 6))
    wrenches[springs.body("bob")] = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]
    expected = np.concatenate([np.cross([0, 0, 0.2], [1.0, 2.0, 3.0]), np.zeros(7)])
    np.testing.assert_allclose(forces_at(springs, REST, wrenches), expected, atol=1e-12)


def test_poses_of_what_is_fixed_to_bodies(x64, springs):
    """Place and turn in the body's frame, carried by it; of the same body twice."""
    kin = jax.jit(rigid_forces.kinematics)(springs, jnp.asarray(REST))
    rng = np.random.default_rng(0)
    position, quaternion = rng.standard_normal((3, 3)), rng.standard_normal((3, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    body = np.array([3, 1, 3])
    attached = jax.jit(lambda kin, *place: rigid_forces.attached(kin, body, *place))
    pose = attached(kin, jnp.asarray(position), jnp.asarray(quaternion))
    for i, b in enumerate(body):
        own = np.zeros(9)
        mujoco.mju_quat2Mat(own, quaternion[i])
        np.testing.assert_allclose(pose.position[i], kin.position[b] + kin.rotation[b] @ position[i], atol=1e-13)
        np.testing.assert_allclose(pose.rotation[i], kin.rotation[b] @ own.reshape(3, 3), atol=1e-13)


def test_penalties_of_limits_and_contacts_are_among_the_forces(x64):
    """A slide 1 cm past its limit and a ball 1 cm in the floor: stiffness times depth each."""
    text = """<mujoco><option gravity="0 0 0"/><worldbody><geom name="floor" type="plane" size="1 1 1"/>
      <body pos="0 0 5"><joint type="slide" axis="0 0 1" range="-1 1" limited="true"/><geom size=".1" contype="0" conaffinity="0"/></body>
      <body pos="0 0 .09"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    model = rigid.load(text, penalty=Penalty(stiffness=1e3, limit_stiffness=500.0))
    force = forces_at(model, np.array([1.01, 0, 0, 0.09, 1, 0, 0, 0]))
    np.testing.assert_allclose(force, [-5.0, 0, 0, 10.0, 0, 0, 0], atol=1e-9)


SLOPE = """<mujoco><option timestep="0.002"/><worldbody><body euler="23 31 17"><geom type="plane" size="5 5 1" friction="0 0 0"/>
</body><body><freejoint/><geom size="0.1" mass="1" friction="0 0 0"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("friction", "rel"), [(0.0, 1e-4), (1e-3, 1e-4), (0.3, 1e-5)])
def test_a_ball_slides_down_a_slope_with_little_or_no_friction_in_single_precision(friction, rel):
    """With a coefficient mu, rows of a contact are 1 / mu^2 times as stiff."""
    mj = mujoco.MjModel.from_xml_string(SLOPE)
    mj.geom_friction[:, 0] = friction
    data = mujoco.MjData(mj)
    mujoco.mj_kinematics(mj, data)
    data.qpos[:3] = data.geom_xmat[0].reshape(3, 3)[:, 2] * 0.0998
    with jax.enable_x64(False):
        model = rigid.load(SLOPE)
        model = model.with_parameters(geom_friction=model.parameters["geom_friction"].at[:, 0].set(friction))
        state = rigid.initial_state(model, data.qpos)
        end = jax.jit(functools.partial(rigid.step, num_substeps=50))(model, state)
        assert rigid.check_status(end, model) == 0
    for _ in range(50):
        mujoco.mj_step(mj, data)
    assert np.linalg.norm(data.qvel[:3]) > 0.3
    np.testing.assert_allclose(end.qvel[:3], data.qvel[:3], rtol=rel, atol=rel)


def test_a_control_at_its_limit_has_the_derivative_of_the_inside(x64):
    """Both limits of a motor; beyond them none. A motor without limits has its own."""
    motors = (
        '<actuator><motor joint="turn0" gear="3" ctrlrange="-1 1" ctrllimited="true"/><motor joint="turn0"/></actuator>'
    )
    model = rigid.load(rigid_models.pendulum(1).replace("</worldbody>", "</worldbody>" + motors))
    state = rigid.initial_state(model)
    slope = jax.jit(jax.grad(lambda ctrl: rigid.step(model, state, ctrl).qvel[0]), compiler_options=unoptimised())
    inside = slope(jnp.zeros(2))
    assert inside[0] == pytest.approx(3.0 * inside[1]) and inside[1] > 0
    for ctrl, share in ((1.0, 1.0), (-1.0, 1.0), (1.0 + 1e-9, 0.0), (-1.0 - 1e-9, 0.0)):
        np.testing.assert_allclose(slope(jnp.array([ctrl, 5.0])), inside * np.array([share, 1.0]), rtol=1e-12)
