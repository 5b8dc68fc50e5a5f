"""Contacts and limits of articulated bodies as springs and dampers: the law written out, and what it does to bodies."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models
from hypothesis import given
from hypothesis import strategies as st

from rewax.physics import rigid
from rewax.physics.rigid.kinematic_tree import TreeParameters, tree_topology
from rewax.physics.rigid.kinematics import body_velocities, kinematics
from rewax.physics.rigid.spring_contacts import Penalty, limit_forces, point_forces

LAW = Penalty(stiffness=2000.0, damping=30.0, friction_damping=12.0, onset=0.004)
PAIR = """<mujoco><worldbody>
  <body name="a" pos="0 0 1"><freejoint/><geom size=".1"/><body pos=".3 0 0"><joint axis="0 1 0"/><geom size=".1"/></body></body>
  <body name="b" pos="1 0 1"><freejoint/><geom type="box" size=".1 .2 .1" pos="0 .1 0"/></body></worldbody></mujoco>"""
NUM = 24


@functools.cache
def tree():
    mj = mujoco.MjModel.from_xml_string(PAIR)
    topology = tree_topology(mj.body_parentid, mj.jnt_bodyid, mj.jnt_type)

    @jax.jit
    def wrenches(law, q, v, distance, point, normal, friction, bodies):
        numbers = {name: jnp.asarray(getattr(mj, name)) for name in TreeParameters._fields}
        kin = kinematics(topology, TreeParameters(**numbers), q)
        twist = body_velocities(topology, kin, v)
        contacts = {"distance": distance, "point": point, "normal": normal, "friction": friction, "bodies": bodies}
        return kin, twist, point_forces(law, kin, twist, **contacts).wrenches()

    return mj, wrenches


def by_hand(law, distance, normal, velocity, friction):
    """Force on the second body of a contact [N]."""
    if distance >= 0:
        return np.zeros(3)
    share = min(-distance / law.onset, 1.0) if law.onset > 0 else 1.0
    v_n = velocity @ normal
    push = -law.stiffness * distance - share * law.damping * min(v_n, 0.0)
    sliding = velocity - v_n * normal
    speed = np.linalg.norm(sliding)
    drag = min(share * law.friction_damping * speed, friction * push)
    return push * normal - drag * sliding / max(speed, 1e-300)


@given(seed=st.integers(0, 10**6), onset=st.sampled_from([0.0, 0.004]))
def test_wrenches_of_contacts_are_the_law_written_out(x64, seed, onset):
    """Of bodies that move and turn, contacts with the world among them; some slide at Coulomb's limit, some do not."""
    mj, wrenches = tree()
    rng, law = np.random.default_rng(seed), LAW.replace(onset=onset)
    q, v = mj.qpos0 + 0.3 * rng.standard_normal(mj.nq), rng.standard_normal(mj.nv)
    distance, point = 0.01 * rng.standard_normal(NUM), rng.standard_normal((NUM, 3))
    normal = rng.standard_normal((NUM, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    friction, bodies = rng.uniform(0, 1, NUM), rng.integers(0, mj.nbody, (NUM, 2))
    kin, twist, got = wrenches(law, q, v, distance, point, normal, friction, bodies)
    kin, twist = jax.tree.map(np.asarray, (kin, twist))
    expected, sticks = np.zeros((mj.nbody, 6)), 0

    def velocity(body, place):
        return twist[body, 3:] + np.cross(twist[body, :3], place - kin.tree_com[body])

    for d, p, n, mu, (first, second) in zip(distance, point, normal, friction, bodies, strict=True):
        sliding = velocity(second, p) - velocity(first, p)
        force = by_hand(law, d, n, sliding, mu)
        tangential = np.linalg.norm(force - (force @ n) * n)
        sticks += d < 0 and tangential < 0.999 * mu * (force @ n)
        for body, f in ((first, -force), (second, force)):
            expected[body] += [*np.cross(p - kin.tree_com[body], f), *f]
    np.testing.assert_allclose(got, expected, atol=1e-11 * np.abs(expected).max())
    assert 0 < sticks < np.sum(distance < 0)
    # Action = reaction: nothing in all, neither force nor torque about one point.
    about_origin = np.asarray(got)[:, :3] + np.cross(kin.tree_com, np.asarray(got)[:, 3:])
    np.testing.assert_allclose(about_origin.sum(axis=0), 0.0, atol=1e-10)
    np.testing.assert_allclose(np.asarray(got)[:, 3:].sum(axis=0), 0.0, atol=1e-11)


@pytest.mark.parametrize(
    ("position", "rate", "force"),
    [
        (0.3, 5.0, 0.0),  # between the limits nothing,
        (1.0, 5.0, 0.0),  # at them too
        (1.1, 0.0, -10.0),
        (1.1, 2.0, -16.0),  # damped on the way in
        (1.1, -2.0, -4.0),  # and on the way out
        (-0.7, 0.0, 20.0),
        (-0.7, -1.0, 23.0),
    ],
)
def test_forces_of_limits(x64, position, rate, force):
    law = LAW.replace(limit_stiffness=100.0, limit_damping=3.0)
    limits = jnp.array([[-0.5, 1.0]])
    got = limit_forces(law, limits, jnp.array([position]), jnp.array([rate]))
    np.testing.assert_allclose(got, [force], atol=1e-12)


def test_with_an_onset_nothing_sets_in_at_once(x64):
    """Force just below the surface of something fast: with an onset next to nothing, without one full damping."""
    _, wrenches = tree()
    mj = tree()[0]
    v = np.zeros(mj.nv)
    v[-6:-3] = [3.0, 0.0, -5.0]
    args = (
        np.array([-1e-9]),
        np.array([[1.0, 0.0, 1.0]]),
        np.array([[0.0, 0.0, 1.0]]),
        np.array([0.9]),
        np.array([[0, 3]]),
    )
    gradual, at_once = (np.asarray(wrenches(LAW.replace(onset=o), mj.qpos0, v, *args)[2])[3, 3:] for o in (0.004, 0.0))
    assert np.abs(gradual).max() < 1e-3
    np.testing.assert_allclose(at_once, [-36.0, 0.0, 150.0], rtol=1e-6)


@jax.jit
def simulate(model, state, ctrl):
    return rigid.step(model, state, ctrl, num_substeps=60)


@functools.cache
def ball():
    law = Penalty(stiffness=3000.0, damping=30.0, friction_damping=50.0, onset=1e-3)
    text = rigid_models.ball(dt=1e-3).replace("pyramidal", "elliptic")  # of no concern to a penalty
    with jax.enable_x64(True):
        return rigid.load(text, penalty=law)


def settle(model, state, ctrl, times: int = 90):
    for _ in range(times):
        state = simulate(model, state, ctrl)
    return state


def test_a_ball_comes_to_rest_as_deep_as_its_weight_demands(x64):
    """And one program does for all numbers of the law."""
    model, nothing = ball(), jnp.zeros(0)
    weight = 9.81 * float(model.parameters["body_mass"][1])
    programs = simulate._cache_size()
    for stiffness in (3000.0, 6000.0):
        soft = model.replace(penalty=model.penalty.replace(stiffness=jnp.asarray(stiffness, float)))
        state = settle(soft, rigid.initial_state(soft, model.home.at[2].set(0.1)), nothing)
        assert 0.1 - float(state.qpos[2]) == pytest.approx(weight / stiffness, rel=1e-6)
        assert float(rigid.contact_distances(soft, state)[0]) == pytest.approx(-weight / stiffness, rel=1e-6)
        np.testing.assert_allclose(state.qvel, 0.0, atol=1e-9)
    assert simulate._cache_size() == programs + 1


def test_a_ball_slides_before_it_rolls(x64):
    """Coulomb's friction slows it at mu g and turns it, until it rolls: with 5/7 of its first speed, were it not soft."""
    model, nothing = ball(), jnp.zeros(0)
    rest = settle(model, rigid.initial_state(model, model.home.at[2].set(0.1)), nothing)
    start = rest.replace(qvel=jnp.array([6.0, 0, 0, 0, 0, 0]))
    soon = simulate(model, start, nothing)
    mu, time = float(model.parameters["pair_friction"][0, 0]), 60 * model.dt
    assert mu == 0.8
    assert 6.0 - float(soon.qvel[0]) == pytest.approx(mu * 9.81 * time, rel=1e-3)
    end = settle(model, start, nothing)
    lever = 0.5 * (0.1 + float(end.qpos[2]))  # contact is half way between the surfaces
    assert float(end.qvel[0]) == pytest.approx(6.0 / (1 + 0.4 * (0.1 / lever) ** 2), rel=1e-3)
    assert float(end.qvel[4]) * lever == pytest.approx(float(end.qvel[0]), rel=1e-3)


def test_a_joint_leans_on_its_limit(x64):
    """A rod that stands out over its limit hangs beyond it by what its weight demands; its margin shifts the limit."""
    text = rigid_models.pendulum(1, dt=1e-3).replace('axis="0 1 0"', 'axis="0 1 0" range="-2 -1.2" margin="0.05"')
    law = Penalty(stiffness=1.0, limit_stiffness=400.0, limit_damping=20.0)
    model = rigid.load(text, penalty=law)
    state = settle(model, rigid.initial_state(model, [-1.3]), jnp.zeros(0))
    mass, length = float(model.parameters["body_mass"][1]), 0.5
    angle = float(state.qpos[0])
    np.testing.assert_allclose(state.qvel, 0.0, atol=1e-9)
    assert -400.0 * (angle + 1.2 + 0.05) == pytest.approx(9.81 * mass * length * np.sin(angle), rel=1e-9)


@pytest.mark.parametrize(
    ("penalty", "sentence"),
    [
        (1e4, r"penalty is 10000.0: give a Penalty"),
        (Penalty(stiffness=-1.0), "the penalty's stiffness is -1.0, but must be 0 or more"),
        (Penalty(stiffness=1e3, onset=np.nan), "the penalty's onset is nan, but must be 0 or more"),
        (Penalty(stiffness=5e4), r"stiffness is 50000 N/m, unstable with a substep of 0.01 s .* all 1 kg at once \(at most 4e\+04"),
        (Penalty(stiffness=1e3, damping=300.0), r"damping is 300 N s/m, unstable with a substep of 0.01 s .*: make it softer or dt shorter"),
    ],
)  # fmt: skip
def test_numbers_that_cannot_be_are_named(penalty, sentence):
    text = '<mujoco><worldbody><body><freejoint/><geom size="0.1" mass="1"/></body></worldbody></mujoco>'
    with pytest.raises(ValueError, match=sentence):
        rigid.load(text, dt=0.01, penalty=penalty)
    rigid.load(text, dt=0.01, penalty=Penalty(stiffness=3e4, damping=100.0))
