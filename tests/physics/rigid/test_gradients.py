"""Derivatives of rigid bodies: reverse = forward = finite difference, smooth and through contact, at many states."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models

from rewax.physics import rigid
from rewax.physics.rigid.spring_contacts import Penalty
from rewax.xla_options import unoptimised

NUM, HORIZON, STEP = 64, 8, 1e-6
slow = pytest.mark.slow


@functools.cache
def loaded(name: str, penalty: Penalty | None = None):
    text = getattr(rigid_models, name)()
    with jax.enable_x64(True):
        return mujoco.MjModel.from_xml_string(text), rigid.load(text, penalty=penalty)


def random_states(name: str, near: bool, seed: int = 0):
    """Positions, velocities and controls of many states, in contact (or about to be) or far from the ground."""
    mj, _ = loaded(name)
    rng = np.random.default_rng(seed)
    qpos = np.tile(mj.qpos0, (NUM, 1)) + 0.05 * rng.standard_normal((NUM, mj.nq))
    qvel, ctrl = 0.5 * rng.standard_normal((NUM, mj.nv)), rng.uniform(-0.9, 0.9, (NUM, mj.nu))
    height, fall = {
        "ball": (2, 0.095), "capsule": (2, 0.05), "pushed_box": (2, 0.095), "box_on_box": (2, 0.195), "hopper": (1, -0.06),
        "ant": (2, 0.28), "hand": (18, 0.1),
    }[name]  # fmt: skip
    qpos[:, height] = fall + 0.01 * rng.standard_normal(NUM) + (0.0 if near else 2.0)
    if name == "capsule":
        qpos[:, 3:7] = [0.7, 0.1, 0.7, 0.0] + 0.05 * rng.standard_normal((NUM, 4))
    if name == "ant":
        qpos[:, 8::2] += 0.6
    if name == "hand":
        qpos[:, 1:16:4] += 0.3
        qpos[:, 16:18] *= 0.1
    if name == "pushed_box":
        qpos[:, 7] = 0.005 + 0.01 * rng.standard_normal(NUM)
        qvel[:, 6] += 0.5
    return jnp.asarray(qpos), jnp.asarray(qvel), jnp.asarray(ctrl)


def share_in_contact(name: str, inputs) -> float:
    """Of the states that touch something within the horizon, by C MuJoCo."""
    mj, touched = loaded(name)[0], 0
    for qpos, qvel, ctrl in zip(*inputs, strict=True):
        data = mujoco.MjData(mj)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        touches = False
        for _ in range(HORIZON):
            mujoco.mj_step(mj, data)
            touches = touches or data.ncon > 0
        touched += touches
    return touched / NUM


def program(name: str, derivatives, penalty: Penalty | None = None, *, everything: bool = False):
    """End of the horizon and its derivatives, of a batch of states and perhaps of all that they depend on."""
    return cached_program(name, derivatives, penalty, everything)


@functools.cache
def cached_program(name, derivatives, penalty, everything):
    model = loaded(name, penalty)[1]

    def simulate(inputs):
        qpos, qvel, ctrl, *rest = inputs
        other, wrenches = model, None
        if everything:
            (parameters, gravity, law), wrenches = rest
            other = model.with_parameters(**parameters).replace(gravity=gravity, penalty=law)
        state = rigid.initial_state(other, qpos, qvel)
        state = rigid.step(other, state, ctrl, wrenches=wrenches, num_substeps=HORIZON)
        return state.qpos, state.qvel

    return derivatives(jax.vmap(simulate), compiler_options=unoptimised())


def with_everything(name: str, inputs, penalty: Penalty | None = None):
    """The same with a model and wrenches for each state."""
    mj, model = loaded(name, penalty)
    parameters = (model.parameters, model.gravity, model.penalty)
    parameters = jax.tree.map(lambda a: jnp.tile(a, (NUM, *(1 for _ in jnp.shape(a)))), parameters)
    wrenches = 0.3 * np.random.default_rng(5).standard_normal((NUM, mj.nbody, 6))
    return (*inputs, parameters, jnp.asarray(wrenches))


def direction(name: str, leaf, rng) -> jax.Array:
    """Random, as large as each number; frames are moved too, the exponent of impedances and what is zero are not."""
    noise = rng.standard_normal(leaf.shape)
    if name.endswith("solimp"):
        noise[..., 4] = 0.0
    moved = ("pos", "quat", "axis", "ipos", "iquat", "qpos0", "spring")
    return jnp.asarray(noise * (0.1 if name.endswith(moved) else np.abs(leaf)))


def weights(out):
    """A random cotangent."""
    rng = np.random.default_rng(3)
    return jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), out)


def per_state(a, b) -> np.ndarray:
    """Scalar products of two trees for each state."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return sum(np.sum((np.asarray(x) * np.asarray(y)).reshape(NUM, -1), axis=1) for x, y in pairs)


def compared(run, inputs, seed: int = 7, rest: bool = False):
    """Derivatives along a random direction per state: reverse, forward, by difference.

    The direction is one of positions, velocities and controls, or one of what else there is.
    """
    rng = np.random.default_rng(seed)
    state = jax.tree.map(lambda a: jnp.asarray((not rest) * rng.standard_normal(a.shape)), inputs[:3])
    move = (*state, *jax.tree.map(jnp.zeros_like, inputs[3:]))
    if rest:
        named = jax.tree_util.tree_map_with_path(
            lambda path, a: direction(path[-1].__str__().strip("[].'"), a, rng), inputs[3]
        )
        move = (*state, named, jnp.asarray(rng.standard_normal(inputs[4].shape)))
    _, tangent, cotangent, gradient = run(inputs, move, weights=weights)
    ahead, behind = (
        run(jax.tree.map(lambda a, m: a + s * m, inputs, move), move, weights=weights)[0] for s in (STEP, -STEP)
    )
    difference = (per_state(cotangent, ahead) - per_state(cotangent, behind)) / (2 * STEP)
    return per_state(gradient, move), per_state(cotangent, tangent), difference


def assert_agree(what: str, reverse, forward, difference, tolerance: float) -> None:
    error = np.abs(reverse - difference) / np.abs(difference)
    modes = np.abs(reverse - forward) / np.abs(forward)
    print(f"{what}: median {np.median(error):.1e}, 90 % {np.quantile(error, 0.9):.1e}, worst {error.max():.1e},"
          f" reverse - forward {modes.max():.1e}")  # fmt: skip
    assert modes.max() < 1e-9
    assert np.median(error) < tolerance


@pytest.mark.parametrize(
    "name", ["box_on_box", "hand", *(pytest.param(n, marks=slow) for n in ("ball", "ant", "capsule", "pushed_box"))]
)
def test_reverse_forward_and_finite_difference_agree(x64, derivatives, name):
    """With respect to positions, velocities and controls, over eight substeps, at 64 states."""
    run = program(name, derivatives)
    for near, tolerance in ((False, 1e-6), (True, 1e-4)):
        inputs = random_states(name, near)
        assert (share_in_contact(name, inputs) > 0.9) == near
        assert_agree(f"{name} {'contact' if near else 'smooth'}", *compared(run, inputs), tolerance)


LAW = Penalty(stiffness=2e4, damping=50.0, friction_damping=100.0, onset=5e-3, limit_stiffness=300.0, limit_damping=3.0)


@pytest.mark.parametrize(
    ("name", "penalty"),
    [("hopper", None), *(pytest.param(name, LAW, marks=slow) for name in ("ball", "hopper"))],
    ids=["hopper", "ball-penalty", "hopper-penalty"],
)
def test_with_respect_to_everything(x64, derivatives, name, penalty):
    """Also to all parameters, gravity, the law of contact and wrenches, each state with its own."""
    run = program(name, derivatives, penalty, everything=True)
    for near, tolerance in ((False, 1e-6), (True, 1e-4)):
        inputs = with_everything(name, random_states(name, near), penalty)
        assert (share_in_contact(name, inputs[:3]) > 0.9) == near
        for rest in (False, True):
            what = f"{name} {'contact' if near else 'smooth'} {'parameters' if rest else 'states'}"
            assert_agree(what, *compared(run, inputs, rest=rest), tolerance)


def test_saturated_controls_have_no_gradient(x64, derivatives):
    qpos, qvel, ctrl = random_states("hopper", near=True)
    inputs = with_everything("hopper", (qpos, qvel, ctrl.at[:, 0].set(1.5).at[:, 1].set(-1.01)))
    *_, gradient = program("hopper", derivatives, None, everything=True)(inputs, inputs, weights=weights)
    np.testing.assert_array_equal(gradient[2][:, :2], 0.0)
    assert np.abs(gradient[2][:, 2]).min() > 0


def test_orientation_depends_on_an_angular_velocity_of_zero(x64, derivatives):
    """Half an angle per unit of it, as for every other; a norm that is guarded at zero would give none."""
    qpos, qvel, ctrl = (0.0 * a for a in random_states("ball", near=False))
    inputs = (qpos.at[:, 2].set(5.0).at[:, 3].set(1.0), qvel, ctrl)
    turn = jnp.asarray(np.random.default_rng(0).standard_normal((NUM, 3)))
    run, dt = program("ball", derivatives), loaded("ball")[1].dt
    (_, _), (moved, _), cotangent, gradient = run(inputs, (0 * qpos, qvel.at[:, 3:].set(turn), ctrl), weights=weights)
    np.testing.assert_allclose(moved[:, 4:], 0.5 * HORIZON * dt * turn, rtol=1e-12)
    np.testing.assert_allclose(moved[:, :4], 0.0, atol=1e-15)
    expected = 0.5 * HORIZON * dt * cotangent[0][:, 4:] + cotangent[1][:, 3:]
    np.testing.assert_allclose(gradient[1][:, 3:], expected, rtol=1e-12)


@pytest.mark.parametrize("name", ["ball", "box_on_box", "hopper"])
def test_derivatives_are_finite_wherever_it_is(x64, derivatives, name):
    """At rest, upright, just touching, deep inside, flying, turned at random."""
    everything = name == "hopper"
    run, rng = program(name, derivatives, None, everything=everything), np.random.default_rng(0)
    qpos, qvel, ctrl = (np.array(a) for a in random_states(name, near=True))
    home = loaded(name)[0].qpos0
    qpos[:8], qvel[:8], ctrl[:8] = home, 0.0, 0.0
    qpos[1, 2 if name != "hopper" else 1] = {"ball": 0.1, "box_on_box": 0.2, "hopper": -0.05}[name]
    qpos[2, 2 if name != "hopper" else 1] = {"ball": 0.0, "box_on_box": 0.0, "hopper": -0.5}[name]
    qpos[3, :3] = 0.0
    qpos[8:] += rng.standard_normal(qpos[8:].shape)
    qvel[16:] *= 30.0
    inputs = tuple(jnp.asarray(a) for a in (qpos, qvel, ctrl))
    if everything:
        inputs = with_everything(name, inputs)
    values, tangents, _, gradient = run(inputs, jax.tree.map(jnp.ones_like, inputs), weights=weights)
    for leaf in jax.tree.leaves((values, tangents, gradient)):
        assert np.isfinite(leaf).all()
    assert np.abs(gradient[1]).max(axis=1).min() > 0


def test_derivatives_of_environments_do_not_see_each_other(x64, derivatives):
    """They do not depend, by a bit, on what is NaN in another; nor, but for rounding, on the place in the batch."""
    run, inputs = program("ball", derivatives), random_states("ball", near=True)
    moves = jax.tree.map(lambda a: 0.0 * a + 1.0, inputs)
    fine = run(inputs, moves, weights=weights)
    poisoned = run((inputs[0].at[3, 2].set(jnp.nan), *inputs[1:]), moves, weights=weights)
    assert np.isnan(poisoned[3][1][3]).any()
    others = np.delete(np.arange(NUM), 3)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[others], b[others]), poisoned, fine)
    turned = run(*(jax.tree.map(lambda a: jnp.roll(a, 16, axis=0), x) for x in (inputs, moves)), weights=weights)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(jnp.roll(a, 16, axis=0), b, rtol=1e-13), fine[:2], turned[:2])


@slow
def test_with_respect_to_every_parameter(x64, derivatives, inner):
    """Of the model and its gravity, of activations, controls and wrenches: each leaf alone, in a model that has them all.

    Reverse = forward to 1e-9 and = finite difference to 1e-4, through limits, dry friction, equalities and contact.
    """
    mj, model = loaded("contraption")
    rng = np.random.default_rng(0)
    wrenches = 0.2 * rng.standard_normal((mj.nbody, 6))
    state = rigid.initial_state(model, mj.key_qpos[0], rng.standard_normal(mj.nv))
    arguments = {
        **model.parameters, "gravity": model.gravity, "qpos": state.qpos, "qvel": state.qvel,
        "act": 0.01 * jnp.ones(mj.na), "ctrl": jnp.asarray(rng.uniform(-0.9, 0.9, mj.nu)), "wrenches": jnp.asarray(wrenches),
    }  # fmt: skip

    def simulate(x):
        numbers = {name: x[name] for name in rigid.PARAMETERS}
        start = state.replace(qpos=x["qpos"], qvel=x["qvel"], act=x["act"])
        changed = model.with_parameters(**numbers).replace(gravity=x["gravity"])
        end = rigid.step(changed, start, x["ctrl"], wrenches=x["wrenches"], num_substeps=HORIZON)
        return end.qpos, end.qvel, end.act

    run = derivatives(simulate, compiler_options=unoptimised())

    def value(x):
        return run(x, still, weights=weights)[0]

    still = jax.tree.map(jnp.zeros_like, arguments)
    _, _, cotangent, gradient = run(arguments, still, weights=weights)
    errors, modes = {}, {}
    for name, leaf in arguments.items():
        rng = np.random.default_rng(len(name))
        states = ("qpos", "qvel", "act", "ctrl", "wrenches")
        move = still | {name: 0.1 * weights(leaf) if name in states else direction(name, leaf, rng)}
        forward, reverse = inner(run(arguments, move, weights=weights)[1], cotangent), inner(gradient, move)
        steps = [jax.tree.map(lambda a, m, s=s: a + s * m, arguments, move) for s in (1e-6, -1e-6)]
        ahead, behind = (inner(value(x), cotangent) for x in steps)
        difference = (ahead - behind) / 2e-6
        assert abs(difference) > 1e-6, f"{name} has no effect"
        errors[name] = abs(reverse - difference) / abs(difference)
        modes[name] = abs(reverse - forward) / abs(forward)
    print({name: f"{error:.0e}" for name, error in errors.items()})
    assert max(modes.values()) < 1e-9, modes
    assert max(errors.values()) < 1e-4, errors


def worst_of_gradient(outcome, x: jax.Array) -> float:
    """Largest difference of a gradient from central differences, relative to its largest component."""
    program = jax.jit(jax.value_and_grad(outcome), compiler_options=unoptimised())
    reverse, moves = program(x)[1], STEP * jnp.eye(len(x))
    difference = jnp.stack([(program(x + move)[0] - program(x - move)[0]) / (2 * STEP) for move in moves])
    return float(jnp.abs(reverse - difference).max() / jnp.abs(difference).max())


BALL_JOINT = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="neck" type="ball" {joint}/>
<geom size=".1" pos=".02 0 .1"/></body></worldbody><actuator>{actuator}</actuator></mujoco>"""


@pytest.mark.parametrize(
    ("joint", "actuator"),
    [('stiffness="50"', ""), pytest.param("", '<position joint="neck" gear="1 .3 2" kp="40"/>', marks=slow)],
    ids=["spring", "servo"],
)
def test_turns_of_a_ball_joint_that_is_at_rest(x64, joint, actuator):
    """The force is zero there, its derivative is not."""
    model = rigid.load(BALL_JOINT.format(joint=joint, actuator=actuator))
    weight = jnp.asarray(np.random.default_rng(0).standard_normal(3))

    def outcome(turn):
        state = rigid.initial_state(model, jnp.concatenate([jnp.ones(1), 0.5 * turn]))
        return rigid.step(model, state, num_substeps=3).qvel @ weight

    assert worst_of_gradient(outcome, jnp.zeros(3)) < 1e-6
    assert worst_of_gradient(outcome, jnp.asarray([1e-5, -2e-5, 1e-5])) < 1e-6  # the series, and where it ends
    assert worst_of_gradient(outcome, jnp.asarray([0.3, -0.5, 0.4])) < 1e-6


def test_bodies_without_mass_and_models_with_few_iterations(x64):
    """A marker on the world without a mass; a model that asks for one iteration of the solver, on the floor."""
    marked = rigid_models.mjcf(
        rigid_models.FLOOR
        + '<body name="mark"><site/></body><body pos="0 0 .099"><freejoint/><geom name="a" size=".1"/>'
        '<body pos=".2 0 0"><joint axis="0 1 0"/><geom name="b" size=".1"/></body></body>',
        extra=rigid_models.touching(("floor", "a"), ("floor", "b")),
    )
    mj = mujoco.MjModel.from_xml_string(marked)
    mj.opt.iterations = 1
    model = rigid.load(mj)
    state = rigid.initial_state(model, qvel=jnp.asarray([1.0, 0.2, -0.3, 0.4, 0.5, 0.6, 0.7]))

    def by_mass(mass):
        return rigid.step(model.with_parameters(body_mass=mass), state, num_substeps=HORIZON).qpos[2]

    gradient = jax.jit(jax.grad(by_mass), compiler_options=unoptimised())(model.parameters["body_mass"])
    assert np.isfinite(gradient).all() and gradient[-1] != 0

    def by_velocity(qvel):
        return rigid.step(model, state.replace(qvel=qvel), num_substeps=HORIZON).qvel.sum()

    assert worst_of_gradient(by_velocity, state.qvel) < 1e-5
