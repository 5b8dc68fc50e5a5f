"""Articulated rigid bodies over many substeps: C MuJoCo's trajectories, conserved quantities, clear errors."""

import functools
import re
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models
from rigid_cases import ARM_ON_THE_FLOOR, CALLS, STEPS, advance, draw, home, hop, loaded, simulate_in_c

from rewax.lowering.report import LoweringWarning
from rewax.physics import rigid
from rewax.physics.rigid import stepping
from rewax.physics.rigid.spring_contacts import Penalty
from rewax.status import Status
from rewax.xla_options import unoptimised

# --- Agreement with C MuJoCo ------------------------------------------------------------------------------------------

FAR, NEAR = "smooth", "touching"
CASES = [
    ("pendulum", FAR, {"turn0": 1.0, "turn1": 2.0}, {}),
    ("ball", FAR, {"ball": 2.0}, {}),
    ("ball", NEAR, {"ball": -0.15}, {"speed": 2.0}),
    ("hopper", FAR, {"z": 1.0}, {}),
    ("hopper", NEAR, {"z": -0.01}, {}),
    ("ant", FAR, {"trunk": 2.0}, {}),
    ("ant", NEAR, {"trunk": -0.05}, {}),
    ("contraption", NEAR, {}, {"speed": 1.0}),
    ("hand", FAR, {"cube": 1.0}, {"push": 0.001}),
    ("hand", NEAR, dict.fromkeys(("j01", "j11", "j21", "j31"), 0.3), {"push": 0.001}),
]
CASES = [pytest.param(*c, id=f"{c[0]}-{c[1]}") for c in CASES]


@pytest.mark.parametrize(("name", "kind", "shifts", "scales"), CASES)
def test_a_hundred_steps_agree_with_mujoco(x64, name, kind, shifts, scales):
    """Positions, velocities, activations and the last accelerations, with controls and wrenches on every body.

    The contraption has the rest: damping, dry friction, connect and joint equalities, tendons, servos, activations, a
    medium. The cube of the hand is touched by balls only: of a box on a plane MJX drops the corners that are a
    millimetre shallower than the deepest, so no agreement can be expected there.
    """
    mj, model = loaded(name)
    qpos, (qvel, ctrl, wrenches) = home(mj, **shifts), draw(mj, **scales)
    data, contacts = simulate_in_c(mj, qpos, qvel, ctrl, wrenches)
    assert (max(contacts) > 0) == (kind == NEAR)
    state = rigid.initial_state(model, qpos, qvel)
    for _ in range(CALLS):
        state = advance(model, state, ctrl, wrenches)
    print(name, kind, np.abs(state.qpos - data.qpos).max(), np.abs(state.qvel - data.qvel).max(), max(contacts))
    np.testing.assert_allclose(state.qpos, data.qpos, atol=1e-8)
    np.testing.assert_allclose(state.qvel, data.qvel, atol=1e-7)
    np.testing.assert_allclose(state.act, data.act, atol=1e-8)
    np.testing.assert_allclose(state.qacc, data.qacc, atol=1e-5, rtol=1e-7)
    assert np.abs(data.qpos - qpos).max() > 0.01


COUPLED = """<mujoco><option gravity="0 0 -2"/><worldbody>
  <body><joint name="a" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body>
  <body pos="0 1 0"><joint name="b" axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body></worldbody>
  <tendon><fixed name="t"><joint joint="a" coef="1"/></fixed><fixed name="u"><joint joint="b" coef="1"/></fixed></tendon>
  <equality><joint joint1="a" joint2="b" polycoef="0.1 1 .2 0 0"/><tendon tendon1="t" tendon2="u"/></equality></mujoco>"""


def test_equalities_of_joints_and_tendons_run_in_cpp():
    model, mj = rigid.load(COUPLED), mujoco.MjModel.from_xml_string(COUPLED)
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:] = [0.2, 0.3], [0.5, -0.4]
    mujoco.mj_step(mj, data)
    with warnings.catch_warnings():
        warnings.simplefilter("error", LoweringWarning)
        state = rigid.initial_state(model, [0.2, 0.3], [0.5, -0.4])
        new = jax.jit(rigid.step, compiler_options=unoptimised())(model, state)
    np.testing.assert_allclose(new.qvel, data.qvel, atol=1e-6)


def test_joint_damping_is_implicit_unless_the_model_says_no(x64):
    text = rigid_models.pendulum(1).replace("<joint ", '<joint damping="4" armature="0.01" ')
    implicit, explicit = (mujoco.MjModel.from_xml_string(text) for _ in range(2))
    explicit.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    ends = [simulate_in_c(mj, [1.0], [20.0], steps=STEPS)[0].qpos for mj in (implicit, explicit)]
    assert np.abs(ends[0] - ends[1]).max() > 1e-4
    for mj, end in zip((implicit, explicit), ends, strict=True):
        model = rigid.load(mj)
        state = advance(model, rigid.initial_state(model, [1.0], [20.0]), np.zeros(0), np.zeros((mj.nbody, 6)))
        np.testing.assert_allclose(state.qpos, end, atol=1e-13)


SERVOS = """<mujoco><compiler autolimits="true" angle="radian"/><option integrator="implicitfast" timestep="0.005"/><worldbody>
  <body pos="0 0 1"><joint name="a" axis="0 1 0" damping=".3"/><geom size=".05" fromto="0 0 0 .3 0 0" type="capsule"/><site name="s"/>
    <body pos=".3 0 0"><joint name="b" axis="0 1 .2" damping=".1"/><geom size=".04" fromto="0 0 0 .3 0 0" type="capsule"/>
      <site name="t" pos=".1 0 .1"/><body pos=".3 0 0"><joint name="c" axis="1 .3 0"/><geom size=".04" fromto="0 0 0 .2 .1 0" type="capsule"/>
  </body></body></body>
  <body pos="2 0 1"><freejoint name="top"/><geom type="box" size=".1 .2 .05"/><geom size=".05" pos=".2 0 .1"/></body></worldbody>
  <tendon><fixed name="cord" damping=".2" stiffness="3"><joint joint="b" coef="1"/><joint joint="c" coef="-.5"/></fixed>
    <spatial name="rope" damping="1"><site site="s"/><site site="t"/></spatial></tendon>
  <actuator><velocity joint="a" kv="2"/><position joint="b" kp="5" kv="1" forcerange="-.6 .6"/>
    <general joint="c" gaintype="affine" gainprm="1 .2 -.7" biastype="affine" biasprm="0 -1 -.3" ctrlrange="-.5 .5"/>
    <velocity tendon="cord" kv=".5"/><muscle name="muscle" joint="a" lengthrange="-1 1" force="3" ctrlrange="0 1"/>
    <general joint="b" dyntype="filter" dynprm=".1" gaintype="affine" gainprm="1 0 -.5"/></actuator></mujoco>"""
"""All that implicitfast is implicit in: damping of joints, tendons and actuators, the spin of a body that flies alone."""


def test_implicitfast_is_mujocos(x64):
    """A hundred steps, some forces saturated."""
    mj, model, qpos, qvel, ctrl = servos()
    data, _ = simulate_in_c(mj, qpos, qvel, ctrl)
    state = rigid.initial_state(model, qpos, qvel)
    for _ in range(CALLS):
        state = advance(model, state, ctrl, np.zeros((mj.nbody, 6)))
    for ours, theirs in ((state.qpos, data.qpos), (state.qvel, data.qvel), (state.act, data.act)):
        np.testing.assert_allclose(ours, theirs, atol=1e-10)
    mj.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    assert np.abs(simulate_in_c(mj, qpos, qvel, ctrl)[0].qpos - data.qpos).max() > 1e-3


HAND = """<mujoco><compiler autolimits="true"/><option integrator="implicitfast" timestep="0.002"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="hand"><joint name="h" axis="0 1 0" damping=".1" actuatorfrcrange="-1 1"/><geom size=".1" pos=".3 0 0"/>
    <body name="l" pos=".3 0 0"><joint name="l" type="slide" axis="0 1 0"/><geom size=".02"/></body>
    <body name="r" pos=".3 0 .1"><joint name="r" type="slide" axis="0 -1 0"/><geom size=".02"/></body></body></worldbody>
<tendon><fixed name="t" damping="5"><joint joint="l" coef=".5"/><joint joint="r" coef=".5"/></fixed>
  <fixed name="all"><joint joint="h" coef=".7"/><joint joint="l" coef=".5"/></fixed></tendon>
<actuator><general tendon="t" gainprm="100" biastype="affine" biasprm="0 -100 -10"/>
  <velocity joint="h" kv="4"/><motor joint="h"/><velocity tendon="all" kv=".5"/></actuator></mujoco>"""
"""Two fingers on one tendon, of which neither moves the other, and a joint whose actuators together are limited."""


@pytest.mark.parametrize("ctrl", [(0.3, 0.2, 3.0, 2.0), (0.3, 0.1, -0.2, 0.1)], ids=["limited", "free"])
def test_damping_that_implicitfast_leaves_out(x64, ctrl):
    mj = mujoco.MjModel.from_xml_string(HAND)
    qpos, qvel = np.array([0.1, 0.02, -0.01]), np.array([0.3, 0.5, -0.4])
    data, _ = simulate_in_c(mj, qpos, qvel, np.array(ctrl))
    model = rigid.load(HAND)
    state = rigid.initial_state(model, qpos, qvel)
    for _ in range(CALLS):
        state = advance(model, state, np.array(ctrl), np.zeros((mj.nbody, 6)))
    np.testing.assert_allclose(state.qpos, data.qpos, atol=1e-11)
    np.testing.assert_allclose(state.qvel, data.qvel, atol=1e-10)


def servos():
    """The model twice, and a state and controls at which some of its forces are saturated."""
    mj, rng = mujoco.MjModel.from_xml_string(SERVOS), np.random.default_rng(0)
    qvel, ctrl = 4.0 * rng.standard_normal(mj.nv), rng.uniform(-1, 1, mj.nu)
    return mj, rigid.load(SERVOS), mj.qpos0 + np.array([0.3, -0.2, 0.4, *np.zeros(7)]), qvel, ctrl


@pytest.mark.slow
def test_derivatives_of_implicitfast(x64, derivatives, central_difference, random_like, inner):
    """Reverse, forward and difference agree for states, controls and numbers."""
    _, model, qpos, qvel, ctrl = servos()
    start, rng = rigid.initial_state(model, qpos, qvel), np.random.default_rng(1)
    names = ("dof_damping", "actuator_gainprm", "actuator_biasprm", "body_mass", "body_ipos")
    x = (start.qpos, start.qvel, jnp.asarray(ctrl), {name: model.parameters[name] for name in names})
    move = (*random_like(1, x[:3]), jax.tree.map(lambda a: a * rng.uniform(0.5, 1.0, a.shape), x[3]))

    def end(x):
        after = rigid.step(model.with_parameters(**x[3]), start.replace(qpos=x[0], qvel=x[1]), x[2], num_substeps=2)
        return after.qpos, after.qvel

    quick = unoptimised()
    _, forward, weights, reverse = derivatives(end, compiler_options=quick)(x, move, lambda v: random_like(2, v))
    expected = central_difference(jax.jit(end, compiler_options=quick), x, move, 1e-6)
    for found, true in zip(forward, expected, strict=True):
        np.testing.assert_allclose(found, true, atol=1e-7 * np.abs(true).max())
    assert inner(weights, forward) == pytest.approx(inner(reverse, move), rel=1e-9)


def test_an_activation_at_the_end_of_its_range_keeps_its_derivative(x64):
    """It starts at 0, the lower end: that of an activation inside, also after several substeps."""
    actuator = '<actuator><general joint="turn0" dyntype="integrator" actrange="0 1" actlimited="true"/></actuator>'
    model = rigid.load(rigid_models.pendulum(1).replace("</worldbody>", "</worldbody>" + actuator))
    state, still = rigid.initial_state(model, [1.0]), jnp.zeros(1)

    def end(ctrl):
        return rigid.step(model, state, ctrl, num_substeps=4).act[0]

    @functools.partial(jax.jit, compiler_options=unoptimised())
    def all_three(ctrl):
        return end(ctrl), jax.grad(end)(ctrl)[0], jax.jvp(end, (ctrl,), (jnp.ones(1),))[1]

    start, *slopes = all_three(still)
    ahead = (all_three(still + 1e-3)[0] - start) / 1e-3
    np.testing.assert_allclose([*slopes, ahead], 4 * model.dt, rtol=1e-9)
    assert all_three(still - 1.0)[0] == 0.0 and all_three(still + 1e6)[0] == 1.0


def test_single_precision_stays_single():
    """Of every leaf, with an activation and several kinds of rows; integers are taken as reals."""
    with jax.enable_x64(False):
        model = rigid.load(ARM_ON_THE_FLOOR)
        state = rigid.initial_state(model, [0, 0, 1], [0] * model.num_dofs)
        end = jax.eval_shape(lambda m, s: rigid.step(m, s, [0] * m.num_actuators, num_substeps=2), model, state)
    assert {leaf.dtype for leaf in jax.tree.leaves((model, state, end))} == {np.dtype(np.float32)}
    jax.tree.map(lambda a, b: (a.shape, a.weak_type) == (b.shape, b.weak_type) or pytest.fail(f"{a} {b}"), state, end)


# --- Arguments --------------------------------------------------------------------------------------------------------


def test_wrong_arguments_are_named():
    model = rigid.load(rigid_models.hopper())
    state = rigid.initial_state(model)
    for call, sentence in (
        (lambda: rigid.initial_state(model, np.zeros(5)), "qpos has shape (5,): give shape (6,)"),
        (lambda: rigid.initial_state(model, qvel=np.zeros((6, 1))), "qvel has shape (6, 1): give shape (6,)"),
        (
            lambda: rigid.initial_state(model, np.full(6, np.nan)),
            "qpos holds a number that is not finite ([nan nan nan nan nan nan]): give a finite start",
        ),
        (
            lambda: rigid.initial_state(model, qvel=np.array([0, 0, 0, np.inf, 0, 0.0])),
            "qvel holds a number that is not finite ([ 0.  0.  0. inf  0.  0.]): give a finite start",
        ),
        (
            lambda: rigid.step(model, state, np.zeros(2)),
            "ctrl has shape (2,): give shape (3,) (one number per actuator of the model)",
        ),
        (
            lambda: rigid.step(model, state, wrenches=np.zeros((6, 5))),
            "wrenches has shape (6, 5): give shape (5, 6) (force and torque per body, the world included)",
        ),
        (lambda: rigid.step(model, state, num_substeps=0), "num_substeps is 0: give an integer, at least 1"),
        (
            lambda: model.with_parameters(body_mass=np.ones(3)),
            "body_mass has shape (3,): give shape (5,), as in the model",
        ),
        (
            lambda: model.with_parameters(mass=np.ones(5)),
            "a rigid model has no parameter 'mass': known are qpos0, body_pos,",
        ),
        (
            lambda: model.with_parameters(dof_frictionloss=np.ones(6)),
            "joint 'x' was loaded without dof_frictionloss, so it cannot change: give it a positive value in the MJCF",
        ),
    ):
        with pytest.raises(ValueError, match="^" + re.escape(sentence)):
            call()


def test_numbers_of_another_precision_than_jax_has_are_refused():
    model = rigid.load(rigid_models.ball())
    state = rigid.initial_state(model)
    sentence = "^the model has numbers of {} and its state of {}, but JAX computes with {} here: load the model and"
    with jax.enable_x64(True):
        double = rigid.load(rigid_models.ball())
        with pytest.raises(ValueError, match=sentence.format("float32", "float32", "float64")):
            rigid.step(model, state)
        with pytest.raises(ValueError, match=sentence.format("float64", "float32", "float64")):
            rigid.step(double, state)
        both = double, rigid.initial_state(double)
    with pytest.raises(ValueError, match=sentence.format("float64", "float64", "float32")):
        rigid.step(*both)


def test_status_flags_what_is_not_finite_or_soon_will_be():
    model = rigid.load(rigid_models.ball())
    state = rigid.initial_state(model)
    assert int(rigid.check_status(state)) == Status.OK
    assert int(rigid.check_status(state.replace(qpos=state.qpos.at[1].set(-9e5)))) == Status.OK
    assert int(rigid.check_status(state.replace(qpos=state.qpos.at[1].set(-2e6)))) == Status.NAN
    for broken in (
        state.replace(qpos=state.qpos.at[1].set(jnp.nan)),
        state.replace(qvel=state.qvel.at[5].set(jnp.inf)),
        state.replace(qacc=state.qacc.at[0].set(jnp.nan)),
        state.replace(act=jnp.array([jnp.inf])),
    ):
        assert int(rigid.check_status(broken)) == Status.NAN


def test_constraint_forces_that_do_not_balance_are_reported(monkeypatch):
    """One iteration does not suffice for a rod that hits the ground, but for one in the air."""
    monkeypatch.setattr(stepping, "_MIN_ITERATIONS", 1)
    move = jax.jit(functools.partial(rigid.step, num_substeps=3), compiler_options=unoptimised())
    for iterations, status in ((1, Status.UNSOLVED), (50, Status.OK)):
        model = rigid.load(rigid_models.capsule(), iterations=iterations)
        start = rigid.initial_state(model, model.home.at[2].set(0.22), jnp.array([3.0, 0.0, -1.0, 5.0, 0.0, 5.0]))
        end = move(model, start)
        assert int(rigid.check_status(end)) == status
        assert int(rigid.check_status(move(model, end.replace(qpos=end.qpos.at[2].set(1.0))))) == Status.OK


# --- Substeps and environments ----------------------------------------------------------------------------------------


def test_substeps_are_steps(x64):
    """Twenty at once or two after two: the same. Again: the same to the bit."""
    _, model = loaded("ball")
    start = rigid.initial_state(model, model.home.at[2].set(0.09), jnp.arange(6) * 0.3)
    nothing = jnp.zeros(0)
    at_once, state = (advance(model, start, nothing, jnp.zeros((model.num_bodies, 6))), start)
    for _ in range(STEPS // 2):
        state = hop(model, state, nothing)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11), at_once, state)
    jax.tree.map(np.testing.assert_array_equal, hop(model, state, nothing), hop(model, state, nothing))


def test_environments_do_not_see_each_other(x64):
    """vmap = loop; what is NaN in one env stays there; each env may have its own masses."""
    _, model = loaded("ball")
    rng = np.random.default_rng(0)
    qpos = np.tile(np.asarray(model.home), (4, 1))
    qpos[:, 2] = [0.08, 0.095, 0.12, 0.0999]
    states = jax.vmap(lambda q, v: rigid.initial_state(model, q, v))(qpos, rng.standard_normal((4, 6)))
    masses = model.parameters["body_mass"] * jnp.asarray(rng.uniform(0.5, 2.0, (4, 1)))

    @jax.jit
    @jax.vmap
    def advance_all(mass, state):
        return rigid.step(model.with_parameters(body_mass=mass), state, num_substeps=2)

    together = advance_all(masses, states)
    for env in range(4):
        alone = hop(model.with_parameters(body_mass=masses[env]), jax.tree.map(lambda x: x[env], states), jnp.zeros(0))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a[env], b, rtol=1e-10, atol=1e-12), together, alone)
    poisoned = advance_all(masses, states.replace(qvel=jnp.asarray(states.qvel).at[1, 2].set(jnp.nan)))
    assert np.isnan(poisoned.qpos[1]).any()
    for env in (0, 2, 3):
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[env], b[env]), poisoned, together)


# --- Physics ----------------------------------------------------------------------------------------------------------


def two_balls(penalty: Penalty | None):
    """Two balls of different mass that meet off centre, spinning, without gravity."""
    bodies = "".join(
        f'<body name="b{i}" pos="{x} {0.05 * i} 0"><freejoint/><geom name="b{i}" size="{r}" density="500"/></body>'
        for i, (x, r) in enumerate(((0, 0.1), (0.17, 0.08)))
    )
    text = rigid_models.mjcf(bodies, extra=rigid_models.touching(("b0", "b1")), gravity="0 0 0")
    return rigid.load(text, penalty=penalty)


@pytest.mark.parametrize(
    "penalty", [None, Penalty(stiffness=2e3, damping=5.0, friction_damping=5.0)], ids=["soft", "penalty"]
)
def test_contact_forces_are_equal_and_opposite(x64, penalty):
    """Momentum and angular momentum stay to the last digits while both balls are turned round by a collision."""
    model = two_balls(penalty)
    mass, inertia = np.asarray(model.parameters["body_mass"])[1:], np.asarray(model.parameters["body_inertia"])[1:]
    qvel = jnp.array([1.0, 0.2, -0.1, 3.0, 5.0, -2.0, -2.0, 0.0, 0.3, -4.0, 0.5, 6.0])
    state = rigid.initial_state(model, qvel=qvel)

    def momenta(state):
        x, v, spin = np.asarray(state.qpos).reshape(2, 7), np.asarray(state.qvel).reshape(2, 6), np.zeros((2, 3))
        for ball in range(2):
            mujoco.mju_rotVecQuat(spin[ball], inertia[ball] * v[ball, 3:], x[ball, 3:])
        linear = mass[:, None] * v[:, :3]
        return linear, np.cross(x[:, :3], linear) + spin

    before, largest = momenta(state), 0.0
    for _ in range(10):
        state = hop(model, state, jnp.zeros(0))
        after = momenta(state)
        largest = max(largest, np.abs(after[0][0] - before[0][0]).max())
        np.testing.assert_allclose(after[0].sum(axis=0), before[0].sum(axis=0), atol=1e-13)
        np.testing.assert_allclose(after[1].sum(axis=0), before[1].sum(axis=0), atol=1e-13)
    assert largest > mass.min()  # [kg m/s]: they did collide,
    assert np.abs(after[1] - before[1]).max() > 1e-3  # and rub
    assert np.linalg.norm(state.qpos[:3] - state.qpos[7:10]) > 0.18  # and part


def test_a_pendulum_keeps_its_energy_and_its_period(x64):
    """A rod on a hinge: no drift in 20 swings from 1.2 rad, and the period of theory at a small angle."""
    model = rigid.load(rigid_models.pendulum(1))
    parameters = model.parameters
    mass, length = float(parameters["body_mass"][1]), float(-parameters["body_ipos"][1, 2])
    inertia = float(parameters["body_inertia"][1].max()) + mass * length**2
    assert length == pytest.approx(0.5)

    @jax.jit
    def swing(model, angle):
        def body(state, _):
            state = rigid.step(model, state)
            return state, (state.qpos[0], state.qvel[0])

        return jax.lax.scan(body, rigid.initial_state(model, angle[None]), None, length=8000)[1]

    angle, rate = (np.asarray(a) for a in swing(model, jnp.array(1.2)))
    # Rates are those of half a step earlier.
    middle = 0.5 * (rate[1:] + rate[:-1])
    energy = 0.5 * inertia * middle**2 + mass * 9.81 * length * (1 - np.cos(angle[:-1]))
    start = mass * 9.81 * length * (1 - np.cos(1.2))
    np.testing.assert_allclose(energy, start, rtol=1e-3)
    assert energy[-500:].max() == pytest.approx(energy[:500].max(), rel=1e-4)
    angle = np.asarray(swing(model, jnp.array(0.01))[0])
    down = np.flatnonzero((angle[1:] <= 0) & (angle[:-1] > 0))
    crossings = down + angle[down] / (angle[down] - angle[down + 1])
    period = np.diff(crossings).mean() * model.dt
    assert period == pytest.approx(2 * np.pi * np.sqrt(inertia / (mass * 9.81 * length)), rel=1e-4)
