"""Forces of actuators at limits of controls, actuators, tendons and joints: values are MuJoCo's, slopes those of the inside."""

import functools
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from rigid_cases import simulate_in_c

from rewax.lowering.report import LoweringWarning
from rewax.physics import rigid
from rewax.physics.rigid import forces as rigid_forces
from rewax.physics.rigid.actuation import muscle_rates
from rewax.xla_options import unoptimised

PULLED = """<mujoco><option integrator="implicitfast" timestep="0.01"/><worldbody><body>
    <joint name="a" type="slide" axis="1 0 0" damping=".1"/><geom size=".1" mass="1"/>
    <body pos="0 1 0"><joint name="b" type="slide" axis="0 1 0" actuatorfrcrange="-.7 .7"/><geom size=".1" mass="2"/></body>
  </body></worldbody>
  <tendon><fixed name="t" actuatorfrcrange="-1 1.5"><joint joint="a" coef="1"/><joint joint="b" coef=".5"/></fixed></tendon>
  <actuator><motor tendon="t" gear="2"/><velocity tendon="t" kv="3"/><motor joint="a" forcerange="-2 2"/>
    <position joint="b" kp="4" kv="1" forcerange="-.6 .6"/><motor joint="b" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>"""
INSIDE = np.array([0.1, 0.1, 0.5, 0.1, 0.1])
CONTROLS = {
    "inside": INSIDE,
    "tendon above": [0.9, 0.5, 0.5, 0.1, 0.0],
    "tendon below": [-0.5, -0.4, 0.5, -0.1, 0.0],
    "actuators": [0.1, 0.1, -3.0, 2.0, -5.0],
    "joint": [0.3, 0.1, 1.0, 0.2, 1.0],
}


@pytest.fixture(scope="module")
def pulled():
    with jax.enable_x64(True):
        return mujoco.MjModel.from_xml_string(PULLED), rigid.load(PULLED)


def forces(model, ctrl, qvel):
    """Forces on the degrees of freedom but the joints' dampers."""
    state = rigid.initial_state(model, [0.05, -0.1], qvel)
    kin = rigid_forces.kinematics(model, state.qpos)
    m, d = rigid_forces.mjx_data(model, kin, state, ctrl)
    force, _ = rigid_forces.applied_forces(model, kin, m, d, jnp.zeros((model.num_bodies, 6)))
    return force + jnp.array([0.1, 0.0]) * qvel


all_forces = jax.jit(forces, compiler_options=unoptimised())
slopes = jax.jit(
    lambda model, ctrl, qvel: [jacobian(forces, argnums=1)(model, ctrl, qvel) for jacobian in (jax.jacrev, jax.jacfwd)],
    compiler_options=unoptimised(),
)
"""By controls, in reverse and forward: arrays of shape (num_dofs, num_actuators)."""
REST, MOVING = np.zeros(2), np.array([0.4, -0.3])


@pytest.mark.parametrize("qvel", (REST, MOVING), ids=("at rest", "moving"))
def test_limited_forces_are_mujocos(x64, pulled, qvel):
    mj, model = pulled
    data = mujoco.MjData(mj)
    for name, ctrl in CONTROLS.items():
        data.qpos[:], data.qvel[:], data.ctrl[:] = [0.05, -0.1], qvel, ctrl
        mujoco.mj_forward(mj, data)
        np.testing.assert_allclose(
            all_forces(model, np.array(ctrl), qvel), data.qfrc_actuator, atol=1e-12, err_msg=name
        )


def test_a_step_has_the_damping_of_mujoco_at_limits(x64, pulled):
    """``implicitfast`` leaves out actuators at the limits of their tendons and joints and at their own."""
    mj, model = pulled
    step = jax.jit(lambda state, ctrl: rigid.step(model, state, ctrl), compiler_options=unoptimised())
    for name, ctrl in CONTROLS.items():
        data = mujoco.MjData(mj)
        data.qpos[:], data.qvel[:], data.ctrl[:] = [0.05, -0.1], [0.4, -0.3], ctrl
        mujoco.mj_step(mj, data)
        with warnings.catch_warnings():
            warnings.simplefilter("error", LoweringWarning)  # MJX sorts a tendon's wraps, which nothing here needs
            new = step(rigid.initial_state(model, [0.05, -0.1], [0.4, -0.3]), jnp.asarray(ctrl))
        np.testing.assert_allclose(new.qvel, data.qvel, atol=1e-12, err_msg=name)


def test_slopes_at_zero_force_of_a_limited_tendon(x64, pulled):
    """MJX divides the limit by this force, and its gradient is NaN."""
    moments = np.array([[1.0, 0.5], [1.0, 0.5], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    gains = np.array([2.0, 3.0, 1.0, 4.0, 1.0])  # the gear of a motor is in its moment
    for slope in slopes(pulled[1], np.zeros(5), REST):
        np.testing.assert_allclose(slope, (gains[:, None] * moments).T, atol=1e-12)


def test_slopes_at_a_limit_are_those_of_the_inside(x64, pulled):
    """MJX's are half of them."""
    _, model = pulled
    at_limits = np.array(
        [0.0, 0.5, 2.0, 0.05, 0.0]
    )  # the tendon pulls with 1.5, the motor with 2, the joint turns with .6
    for slope in slopes(model, at_limits, REST):
        assert slope[0, 1] == 3.0 and slope[0, 2] == 1.0


@pytest.mark.parametrize("width", [0.0, 0.2])
def test_rates_of_muscles_are_mujocos(x64, width):
    """And their slopes those of one-sided differences towards the inside, also where MJX's are half or less."""
    mj = mujoco.MjModel.from_xml_string(MUSCLE.format(width=width))
    points = [(0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.3, 0.3), (0.5, 0.1), (0.2, 0.25), (0.9, 0.2), (1.3, 0.5)]
    ctrl, act = (np.array(column) for column in zip(*points, strict=True))
    prm = np.tile(mj.actuator_dynprm[0], (len(points), 1))
    np.testing.assert_allclose(prm[0, :3], [0.01, 0.04, width])

    def mujocos(ctrl, act):
        return np.array(
            [mujoco.mju_muscleDynamics(c, a, mj.actuator_dynprm[0, :3, None]) for c, a in zip(ctrl, act, strict=True)]
        )

    rates = jax.jit(muscle_rates, compiler_options=unoptimised())(ctrl, act, prm)
    np.testing.assert_allclose(rates, mujocos(ctrl, act), rtol=1e-12, atol=1e-12)
    slope = jax.jit(jax.grad(lambda c: muscle_rates(c, act, prm).sum()), compiler_options=unoptimised())(ctrl)
    inside = np.where(ctrl < 1.0, 1e-8, -1e-8)
    expected = (mujocos(ctrl + inside, act) - rates) / inside
    np.testing.assert_allclose(slope[:7], expected[:7], rtol=1e-5)
    assert slope[7] == 0.0


MUSCLE = """<mujoco><compiler angle="radian"/><option timestep="0.005"/><worldbody><body>
  <joint name="j" axis="0 1 0" damping=".1"/><geom size=".02" pos=".2 0 0" mass=".3" contype="0" conaffinity="0"/>
</body></worldbody><actuator><muscle joint="j" lengthrange="-1 1" force="3" tausmooth="{width}"/></actuator></mujoco>"""


def test_muscles_have_a_gradient_in_single_precision():
    """MJX divides by the width of the transition, 0 by default, and its fifth power overflows.

    It is that of MuJoCo's differences in double precision, towards the inside at both ends.
    """
    text = MUSCLE.format(width=0.0)
    mj, model = mujoco.MjModel.from_xml_string(text), rigid.load(text)

    def velocity(ctrl):
        return rigid.step(model, rigid.initial_state(model), ctrl, num_substeps=3).qvel[0]

    def mujocos(ctrl):
        return simulate_in_c(mj, [0.0], [0.0], [ctrl], steps=3)[0].qvel[0]

    ctrl = np.array([0.0, 0.05, 0.5, 1.0])
    slopes = jax.jit(jax.vmap(jax.grad(velocity)), compiler_options=unoptimised())(jnp.asarray(ctrl)[:, None])
    inside = np.where(ctrl < 1.0, 1e-7, -1e-7)
    expected = [(mujocos(c + step) - mujocos(c)) / step for c, step in zip(ctrl, inside, strict=True)]
    np.testing.assert_allclose(slopes[:, 0], expected, rtol=1e-4)
    assert np.max(expected) < -1e-2


def test_slopes_beyond_limits(x64, pulled):
    """Central differences; zero for an actuator beyond its range, not for those that share a limited tendon."""
    _, model = pulled
    for name in ("tendon above", "tendon below", "actuators"):
        ctrl, steps = np.array(CONTROLS[name]), 1e-6 * np.eye(5)
        ends = [[all_forces(model, ctrl + side * step, MOVING) for step in steps] for side in (1, -1)]
        expected = np.transpose(np.array(ends[0]) - np.array(ends[1])) / 2e-6
        for slope in slopes(model, ctrl, MOVING):
            np.testing.assert_allclose(slope, expected, atol=1e-8, err_msg=name)


SERVOS = {
    "direct": '<position joint="j" kp="2" kv="0.3" gear="0 0 1"/>',
    "filter": '<general joint="j" dyntype="filter" dynprm="0.1" gainprm="2" biastype="affine" biasprm="0 -2 -0.3" gear="0 0 1"/>',
    "exact": '<position joint="j" kp="2" kv="0.3" timeconst="0.1" gear="0 0 1"/>',
    "integrated": '<intvelocity joint="j" kp="20" kv="3" gear="0 0 1" actrange="-9 9"/>',
    "scaled": '<position joint="j" kp="2" timeconst="0.1" gear="0 0 1.7"/>',
    "idle": '<position joint="j" kp="2" timeconst="0.1" gear="0 0 0"/>',
    "no servo": '<general joint="j" dyntype="filter" dynprm="0.1" gainprm="2" biastype="affine" biasprm="0 -1.5 0" gear="0 0 1"/>',
}  # fmt: skip


def turned(kinds):
    """A model with a free ball joint for each of the servos."""
    bodies, actuators = "", ""
    for k, kind in enumerate(kinds):
        bodies += f"""<body><joint name="j{k}" type="ball"/>
          <geom type="box" size=".1 .2 .3" density="20" contype="0" conaffinity="0"/></body>"""
        actuators += SERVOS[kind].replace('"j"', f'"j{k}"')
    return f"""<mujoco><option timestep="0.004" gravity="0 0 0"/><worldbody>{bodies}</worldbody>
      <actuator>{actuators}</actuator></mujoco>"""


def test_servos_of_ball_joints_take_mujocos_way_around(x64):
    """In some starts the set point, the activation or both lie more than half a turn from the joint, or come to lie."""
    xml, num = turned(SERVOS), len(SERVOS)
    mj, model = mujoco.MjModel.from_xml_string(xml), rigid.load(xml)
    step = jax.jit(lambda state, ctrl: rigid.step(model, state, ctrl), compiler_options=unoptimised())
    rng, data = np.random.default_rng(3), mujoco.MjData(mj)
    for angle, act, ctrl in (
        (-2.5, 3.1, 3.0),
        (2.7, 8.99, 2.0),
        (2.0, -1.5, -4.5),
        (-2.5, -3.0, 5.0),
        (2.0, 5.06, 20.0),
    ):
        axis = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
        qpos = np.tile(np.r_[np.cos(angle / 2), np.sin(angle / 2) * axis], num)
        qvel = np.tile(rng.normal(size=3), num)
        mujoco.mj_resetData(mj, data)
        data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = qpos, qvel, act, ctrl
        state = rigid.initial_state(model, qpos, qvel).replace(act=jnp.full(mj.na, act))
        for _ in range(3):
            mujoco.mj_step(mj, data)
            state = step(state, jnp.full(num, ctrl))
            np.testing.assert_allclose(state.qvel, data.qvel, atol=1e-12, err_msg=str(angle))
            np.testing.assert_allclose(state.act, data.act, atol=1e-12, err_msg=str(angle))


def test_slopes_of_a_filtered_servo_that_turns_the_short_way(x64):
    model = rigid.load(turned(["exact"]))

    def after(inputs):
        angle, act, ctrl = inputs
        state = rigid.initial_state(model, jnp.array([jnp.cos(angle / 2), 0.0, 0.0, jnp.sin(angle / 2)]))
        new = rigid.step(model, state.replace(act=act[None]), ctrl[None])
        return jnp.array([new.qvel[2], new.act[0]])

    @functools.partial(jax.jit, compiler_options=unoptimised())
    def all_three(inputs):
        return after(inputs), jax.jacrev(after)(inputs), jax.jacfwd(after)(inputs)

    inputs, numeric = np.array([-2.5, 3.1, 3.0]), np.zeros((2, 3))
    for k, change in enumerate(1e-6 * np.eye(3)):
        numeric[:, k] = (all_three(inputs + change)[0] - all_three(inputs - change)[0]) / 2e-6
    _, exact, forward = all_three(inputs)
    np.testing.assert_allclose(exact, numeric, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(forward, exact, rtol=1e-12, atol=1e-15)
