"""Articulated rigid bodies: C MuJoCo's trajectories, conserved quantities, one program per model, clear errors."""

import functools
import importlib.metadata
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models
from mujoco import mjx

from rewax.physics import rigid
from rewax.physics.rigid import forces as rigid_forces
from rewax.physics.rigid.penalty import Penalty
from rewax.status import Status

STEPS, CALLS = 20, 5


@functools.cache
def loaded(name: str):
    """MuJoCo's model and ours, in double precision."""
    text = getattr(rigid_models, name)()
    with jax.enable_x64(True):
        return mujoco.MjModel.from_xml_string(text), rigid.load(text)


@functools.partial(jax.jit, compiler_options=rigid_models.QUICK_TO_COMPILE)
def advance(model, state, ctrl, wrenches):
    return rigid.step(model, state, ctrl, wrenches=wrenches, num_substeps=STEPS)


def simulate_in_c(mj, qpos, qvel, ctrl=0.0, wrenches=0.0, steps: int = STEPS * CALLS, act=0.0):
    """MuJoCo's data after some steps, and its number of contacts before each."""
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:], data.ctrl[:], data.xfrc_applied[:] = qpos, qvel, ctrl, wrenches
    data.act[:] = act
    contacts = []
    for _ in range(steps):
        mujoco.mj_step(mj, data)
        contacts.append(data.ncon)
    return data, contacts


def names(mj, kind: str) -> set[str]:
    count = {"joint": mj.njnt, "body": mj.nbody}[kind]
    return {getattr(mj, kind)(i).name for i in range(count)}


def home(mj, **shifts: float) -> np.ndarray:
    """MuJoCo's positions of the model's home, some joints (or free bodies' heights) shifted."""
    qpos = mj.key_qpos[0].copy() if mj.nkey else mj.qpos0.copy()
    for joint, shift in shifts.items():
        number = mj.joint(joint).id if joint in names(mj, "joint") else mj.body(joint).jntadr[0]
        free = mj.jnt_type[number] == mujoco.mjtJoint.mjJNT_FREE
        qpos[mj.jnt_qposadr[number] + 2 * free] += shift
    return qpos


def draw(mj, speed: float = 0.3, push: float = 0.2, seed: int = 0):
    """Velocities, controls and wrenches."""
    rng = np.random.default_rng(seed)
    wrenches = push * rng.standard_normal((mj.nbody, 6))
    wrenches[0] = 0.0
    return speed * rng.standard_normal(mj.nv), rng.uniform(-1, 1, mj.nu), wrenches


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


ARM_ON_THE_FLOOR = rigid_models.mjcf(
    rigid_models.FLOOR
    + """<body pos="0 0 .3"><joint name="a" axis="0 1 0" range="0.1 2" frictionloss=".2"/><geom size=".05" fromto="0 0 0 .3 0 0" type="capsule"/>
      <body name="fore" pos=".3 0 0"><joint name="b" axis="0 1 .2"/><geom name="tip" size=".06" pos=".2 0 -.25"/>
      <body name="last" pos=".1 0 0"><joint name="c" axis="1 0 0"/><geom size=".05" pos="0 .1 0"/></body></body></body>""",
    extra='<equality><connect body1="fore" body2="world" anchor=".3 0 0"/><joint joint1="b" joint2="c" polycoef="0 .3 .4 0 0"/></equality>'
    + '<actuator><general joint="a" dyntype="filter" dynprm=".1" gainprm="2"/></actuator>'
    + rigid_models.touching(("floor", "tip")),
)


def test_single_precision_stays_single():
    """Of every leaf, with an activation and several kinds of rows; integers are taken as reals."""
    with jax.enable_x64(False):
        model = rigid.load(ARM_ON_THE_FLOOR)
        state = rigid.initial_state(model, [0, 0, 1], [0] * model.num_dofs)
        end = jax.eval_shape(lambda m, s: rigid.step(m, s, [0] * m.num_actuators, num_substeps=2), model, state)
    assert {leaf.dtype for leaf in jax.tree.leaves((model, state, end))} == {np.dtype(np.float32)}
    jax.tree.map(lambda a, b: (a.shape, a.weak_type) == (b.shape, b.weak_type) or pytest.fail(f"{a} {b}"), state, end)


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


ADDED = {
    "qpos0",
    "qpos_spring",
    "body_pos",
    "body_quat",
    "body_ipos",
    "body_iquat",
    "jnt_pos",
    "jnt_axis",
    "geom_pos",
    "geom_quat",
}


def changed(mj, name: str) -> np.ndarray:
    """Other numbers for a parameter: all factors a few per cent different, places a centimetre, turns a degree."""
    value, rng = np.array(getattr(mj, name)), np.random.default_rng(len(name))
    new = (
        value + 0.02 * rng.standard_normal(value.shape)
        if name in ADDED
        else value * rng.uniform(1.02, 1.1, value.shape)
    )
    if name.endswith(("quat", "axis")):
        new /= np.linalg.norm(new, axis=1, keepdims=True)
    free = mj.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    if name == "jnt_pos":
        new[free] = value[free]  # a free joint has none
    return new


@functools.cache
def plain_contraption():
    """In which C MuJoCo makes no use of what it knew about the numbers when it read the model."""
    mj, model = loaded("contraption")
    mj = mujoco.MjModel.from_xml_string(rigid_models.contraption())
    for field in ("body_sameframe", "geom_sameframe", "site_sameframe"):
        getattr(mj, field)[:] = 0
    assert not mj.body_simple[1:].any()
    mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    mj.geom_rbound[2:] *= 1.5
    return mj, model


@pytest.mark.parametrize("name", rigid.PARAMETERS)
def test_other_parameters_do_what_they_do_in_mujoco(x64, name):
    """Each of them is heeded, and none needs another program."""
    mj, model = plain_contraption()
    qpos, (qvel, ctrl, wrenches) = home(mj), draw(mj, speed=1.0)
    before, value = simulate_in_c(mj, qpos, qvel, ctrl, wrenches, STEPS)[0], np.array(getattr(mj, name))
    new = changed(mj, name)
    try:
        getattr(mj, name)[:] = new
        after = simulate_in_c(mj, qpos, qvel, ctrl, wrenches, STEPS)[0]
    finally:
        getattr(mj, name)[:] = value
    start = rigid.initial_state(model, qpos, qvel)
    unchanged = advance(model, start, ctrl, wrenches)
    np.testing.assert_allclose(unchanged.qpos, before.qpos, atol=1e-7)
    programs = advance._cache_size()
    state = advance(model.with_parameters(**{name: new}), start, ctrl, wrenches)
    assert advance._cache_size() == programs
    print(name, np.abs(state.qpos - after.qpos).max(), np.abs(after.qpos - before.qpos).max())
    np.testing.assert_allclose(state.qpos, after.qpos, atol=1e-7)  # as well as MuJoCo's solver converges
    assert np.abs(after.qpos - before.qpos).max() > 1e-7


@pytest.mark.parametrize("gravity", ["enable", "disable"])
def test_gravity_is_a_leaf_and_can_be_switched_off(x64, gravity):
    mj = mujoco.MjModel.from_xml_string(rigid_models.pendulum(1))
    mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY * (gravity == "disable")
    model = rigid.load(mj)
    expected = [0.0, 0.0, -9.81] if gravity == "enable" else [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(model.gravity, expected)


@functools.cache
def measuring():
    """All that can be asked about a state, as one program."""

    @jax.jit
    def measure(model, state):
        return (
            rigid.body_poses(model, state),
            rigid.geom_poses(model, state),
            rigid.body_velocities(model, state),
            rigid.centers_of_mass(model, state),
            rigid.contact_distances(model, state),
            rigid.check_status(state),
        )

    return measure


def test_what_is_measured_agrees_with_mujoco(x64):
    """Poses of bodies and geoms, velocities of origins, centres of mass, distances, at the state and not before it."""
    mj, model = loaded("contraption")
    qpos, (qvel, *_) = home(mj), draw(mj, speed=1.0)
    bodies, geoms, (velocity, turning), centers, distances, status = measuring()(
        model, rigid.initial_state(model, qpos, qvel)
    )
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(mj, data)
    np.testing.assert_allclose(bodies.position, data.xpos, atol=1e-14)
    np.testing.assert_allclose(bodies.rotation, data.xmat.reshape(-1, 3, 3), atol=1e-14)
    np.testing.assert_allclose(geoms.position, data.geom_xpos, atol=1e-14)
    np.testing.assert_allclose(geoms.rotation, data.geom_xmat.reshape(-1, 3, 3), atol=1e-14)
    np.testing.assert_allclose(centers, data.subtree_com, atol=1e-14)
    both = np.zeros((mj.nbody, 6))
    for body in range(mj.nbody):
        mujoco.mj_objectVelocity(mj, data, mujoco.mjtObj.mjOBJ_XBODY, body, both[body], 0)
    np.testing.assert_allclose(np.concatenate([turning, velocity], axis=1), both, atol=1e-13)
    # Of pairs that touch; sorted, as the order of contacts is MJX's own.
    near = np.sort([contact.dist for contact in data.contact])
    np.testing.assert_allclose(np.sort(np.asarray(distances))[: len(near)], near, atol=1e-14)
    assert int(status) == Status.OK
    assert (model.num_positions, model.num_dofs, model.num_actuators, model.num_bodies) == (
        mj.nq,
        mj.nv,
        mj.nu,
        mj.nbody,
    )
    assert model.dt == mj.opt.timestep
    np.testing.assert_array_equal(model.home, mj.key_qpos[0])
    np.testing.assert_array_equal(loaded("ball")[1].home, loaded("ball")[0].qpos0)


def test_names(x64):
    mj, model = loaded("contraption")
    for body in ("world", "cart", "stone"):
        assert model.body(body) == mj.body(body).id
    assert model.geom("bulb") == mj.geom("bulb").id
    assert model.joint("swing") == (mj.joint("swing").qposadr[0], mj.joint("swing").dofadr[0])
    known = ", ".join(mj.body(i).name for i in range(mj.nbody) if mj.body(i).name)
    with pytest.raises(ValueError, match=f"^the model has no body 'moon': known are {known}$"):
        model.body("moon")
    with pytest.raises(
        ValueError, match=r"^the model has no geom 'cart': known are floor, shelf, bulb, stone, puck, bead$"
    ):
        model.geom("cart")
    with pytest.raises(ValueError, match=r"^the model has no joint 'y': known are x, h, k, w, swing$"):
        model.joint("y")


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
        (lambda: rigid.step(model, state, num_substeps=0), "num_substeps is 0: give a whole number, at least 1"),
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
            "the model was loaded without dof_frictionloss, so it takes none: give its MJCF a little of it",
        ),
    ):
        with pytest.raises(ValueError, match="^" + re.escape(sentence)):
            call()


def test_status_flags_what_is_not_finite_or_soon_will_be():
    model = rigid.load(rigid_models.ball())
    state = rigid.initial_state(model)
    assert int(rigid.check_status(state)) == Status.OK
    assert int(rigid.check_status(state.replace(qpos=state.qpos.at[1].set(-9e5)))) == Status.OK
    assert int(rigid.check_status(state.replace(qpos=state.qpos.at[1].set(-2e6)))) == Status.NAN
    for broken in (
        state.replace(qpos=state.qpos.at[1].set(jnp.nan)),
        state.replace(qvel=state.qvel.at[5].set(jnp.inf)),
    ):
        assert int(rigid.check_status(broken)) == Status.NAN


# --- One program ------------------------------------------------------------------------------------------------------


@jax.jit
def hop(model, state, ctrl):
    return rigid.step(model, state, ctrl, num_substeps=2)


def test_a_model_is_compiled_once(x64):
    """Other numbers, other states and the same MJCF read again are the same program; another model is another one."""
    text = rigid_models.ball()
    first, again = rigid.load(text), rigid.load(mujoco.MjSpec.from_string(text))
    assert first.static == again.static and hash(first.static) == hash(again.static)
    assert jax.tree.structure(first) == jax.tree.structure(again)
    state, before = rigid.initial_state(first), hop._cache_size()
    ends = [hop(first, state, jnp.zeros(0)), hop(again, state, jnp.zeros(0))]
    assert hop._cache_size() == before + 1
    np.testing.assert_array_equal(ends[0].qvel, ends[1].qvel)
    for name in ("body_mass", "pair_friction", "pair_solref", "pair_solimp", "geom_size"):
        other = again.with_parameters(**{name: 1.01 * again.parameters[name]})
        ends.append(hop(other, ends[-1], jnp.zeros(0)))
    ends.append(
        hop(first.replace(gravity=jnp.array([0.0, 1.0, -3.0])), state.replace(qvel=state.qvel + 1.0), jnp.zeros(0))
    )
    assert hop._cache_size() == before + 1
    for other in (
        rigid_models.ball(dt=0.001),
        rigid_models.ball(gravity="0 0 -1"),
        text.replace('condim="3"', "").replace("<pair ", '<pair condim="1" ', 1),
        rigid_models.capsule(),
    ):
        assert rigid.load(other).static != first.static
    assert first.static != "a model"
    with_penalty = rigid.load(text, penalty=Penalty(stiffness=1e4))
    assert jax.tree.structure(with_penalty) != jax.tree.structure(first)
    with jax.enable_x64(False):
        single = rigid.load(text)
    assert single.static != first.static and single.home.dtype == np.float32


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


# --- What is used of MJX ----------------------------------------------------------------------------------------------

VERSIONS = (
    f"mujoco {mujoco.__version__} with mujoco-mjx {importlib.metadata.version('mujoco-mjx')} is not what rewax was written "
    "for (rewax/physics/rigid_model.py, rigid_forces.py):"
)
FUNCTIONS = (
    "collision", "make_constraint", "passive", "transmission", "fwd_actuation", "tendon", "put_model", "make_data",
)  # fmt: skip
READ_AND_WRITTEN = (
    "qpos", "qvel", "act", "ctrl", "xpos", "xmat", "xipos", "ximat", "subtree_com", "cdof", "cvel", "geom_xpos", "geom_xmat",
    "site_xpos", "site_xmat", "qfrc_passive", "qfrc_actuator", "act_dot", "actuator_length", "eq_active",
)  # fmt: skip
OF_THE_IMPLEMENTATION = (
    "ne", "nf", "ncon", "contact", "actuator_moment", "actuator_velocity", "ten_J", "ten_velocity", "efc_J", "efc_D",
    "efc_aref", "efc_frictionloss",
)  # fmt: skip
OF_A_CONTACT = ("dist", "pos", "frame", "includemargin", "friction", "dim", "geom")


def test_mjx_has_what_is_used_of_it():
    mj, model = loaded("contraption")
    data = model.static.data
    missing = [f"mjx.{name}" for name in FUNCTIONS if not callable(getattr(mjx, name, None))]
    for what, holder, fields in (
        ("mjx.Model", model.static.mjx, (*rigid.PARAMETERS, "opt", "site_pos", "site_quat", "eq_data")),
        ("mjx.Data", data, READ_AND_WRITTEN),
        ("mjx.Data._impl", data._impl, OF_THE_IMPLEMENTATION),
        ("Contact", data._impl.contact, OF_A_CONTACT),
    ):
        missing += [f"{what}.{name}" for name in fields if not hasattr(holder, name)]
    assert not missing, f"{VERSIONS} {', '.join(missing)} are gone"
    for name in rigid.PARAMETERS:
        ours, theirs = getattr(mj, name).shape, getattr(model.static.mjx, name).shape
        assert ours == theirs, f"{VERSIONS} {name} has shape {theirs} in MJX and {ours} in MuJoCo"


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
