"""Touch on tasks: weight in the hand, frames, parts of a body, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewax
from rewax.envs.sensing import Sensing
from rewax.envs.wrappers import AutoReset
from rewax.physics.contact import WALLS, Wrench
from rewax.physics.numerics import Pose
from rewax.sensors import Touch, World, octants, touch_everywhere

SENSORS = {
    "touch": Touch(),
    "parts": Touch(points=octants(), frame="body"),
    "palm": Touch(bodies=("palm", "walls"), torque=False),
}


@pytest.fixture(scope="module")
def hand():
    return rewax.make("HandLift", scale="small")


@pytest.fixture(scope="module")
def held(hand):
    """Thirty steps of a hand that holds still: without and with touch."""
    actions = jnp.zeros((30, *hand.action_spec.shape))

    def run(env, key):
        return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, env.reset(key), actions)[1]

    return tuple(jax.jit(run)(env, jax.random.key(0)) for env in (hand, Sensing(env=hand, sensors=SENSORS)))


def test_touch_changes_nothing_but_the_observations(held):
    without, feeling = held
    for name in ("soft", "joint_q"):
        jax.tree.map(np.testing.assert_array_equal, *(getattr(s.physics, name) for s in held))
    for name, value in without.obs.items():
        np.testing.assert_array_equal(value, feeling.obs[name])
    assert without.physics.felt is None and set(feeling.obs) == {*without.obs, *SENSORS}


def test_a_hand_that_holds_dough_feels_its_weight(hand, held):
    """The mean over many steps, while the dough hardly moves."""
    touch = np.asarray(held[1].obs["touch"]).reshape(30, 2, -1, 3)
    mass = float(hand.scene.material.density * hand.scene.particle_volume) * len(hand.rest_positions)
    momentum = mass * np.asarray(held[1].physics.soft.v.mean(1))
    rate = (momentum[-1] - momentum[4]) / (25 * hand.control_dt)
    weight = mass * np.asarray(hand.scene.gravity)
    np.testing.assert_allclose(touch[5:, 0].sum(1).mean(0), weight - rate, atol=2e-3 * np.abs(weight).max())
    assert np.abs(touch[5:, 0].sum(1).mean(0)[1] / weight[1] - 1.0) < 0.2


def test_parts_sum_to_the_whole_in_the_frame_of_the_body(hand, held):
    num = len(Touch().on(hand).bodies)
    whole = np.asarray(held[1].obs["touch"]).reshape(30, 2, num, 3)
    parts = np.asarray(held[1].obs["parts"]).reshape(30, 2, num, 8, 3).sum(3)
    for a, b in ((whole, parts), (whole[:, :, 1], parts[:, :, 1])):
        np.testing.assert_allclose(np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1), atol=1e-4)
    palm = np.asarray(held[1].obs["palm"]).reshape(30, 2, 3)
    np.testing.assert_allclose(palm[:, 0], whole[:, 0, list(hand.feeling_bodies).index("palm")], atol=1e-4)


def test_the_body_frame_turns_the_vectors():
    turn = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    felt = Wrench(jnp.array([[1.0, 2.0, 3.0]] * 2), jnp.array([[0.0, 1.0, 0.0]] * 2))
    world = World(bodies=Pose(jnp.zeros((1, 3)), turn[None]), felt=felt)
    force, torque = Touch(bodies=(0, WALLS), frame="body").measure(world)
    np.testing.assert_allclose(force, [[2.0, -1.0, 3.0], [1.0, 2.0, 3.0]])
    np.testing.assert_allclose(torque, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    seen = Touch(bodies=(0, WALLS), torque=False).see(world, jax.random.key(0))
    np.testing.assert_array_equal(seen, felt.force.reshape(-1))


def test_walls_alone_feel_where_there_are_no_bodies():
    felt = Wrench(jnp.array([[1.0, 2.0, 3.0]]), jnp.array([[0.0, 1.0, 0.0]]))
    for bodies in (None, Pose(jnp.zeros((0, 3)), jnp.zeros((0, 3, 3)))):
        found = Touch(bodies=(WALLS,), frame="body").measure(World(bodies=bodies, felt=felt))
        np.testing.assert_array_equal(found.force, felt.force)


def test_indices_may_be_numpys():
    for bodies in (np.int64(2), (np.int32(2),)):
        assert Touch(bodies=bodies).patches.body == (2,)


def test_the_gradient_can_be_cut():
    def seen(x, touch):
        world = World(felt=Wrench(x * jnp.ones((1, 3)), jnp.zeros((1, 3))))
        return touch.see(world, jax.random.key(0)).sum()

    assert jax.grad(seen)(1.0, Touch(bodies=(0,))) == 3.0
    assert jax.grad(seen)(1.0, Touch(bodies=(0,), gradient=False)) == 0.0


def test_rigid_bodies_feel_and_an_episode_begins_untouched():
    env = rewax.make("Hopper", scale="small")
    env = AutoReset(env=Sensing(env=env.replace(max_steps=12), sensors={"touch": touch_everywhere(env)}))

    def run(key):
        start = env.reset(key)
        return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, start, jnp.zeros((12, *env.action_spec.shape)))[1]

    state = jax.jit(run)(jax.random.key(0))
    assert np.abs(state.final_obs["touch"]).max() > 10.0
    assert not np.any(state.obs["touch"][-1]) and not np.any(state.physics.felt["touch"].force[-1])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda task: Touch(bodies=("thumb",)).on(task), r"bodies has 'thumb', but HandLift can feel \["),
        (lambda task: Touch(bodies=(99,)).on(task), "bodies has 99, but HandLift can feel"),
        (lambda task: Touch(bodies=("palm", "palm")), "give each body once"),
        (lambda task: Touch(frame="hand"), "frame is 'hand'"),
        (lambda task: Touch(torque=1), "torque is 1: give True or False"),
        (lambda task: Touch(points=np.zeros((2, 2))), r"points has shape \(2, 2\)"),
        (lambda task: Touch(bodies=("palm",), points=np.zeros((2, 2, 3))).on(task), "there are 1 bodies"),
        (lambda task: Touch().patches, "give indices, or use Touch.on"),
        (lambda task: Touch(bodies=(0,)).measure(World()), "the world has nothing felt"),
        (lambda task: Touch().on(object()), "object feels no contact"),
        (lambda task: Sensing(env=task, sensors={"touch": Touch(bodies="ring")}), "bodies has 'ring'"),
    ],
)
def test_bad_touch_is_refused_in_a_sentence(hand, make, message):
    with pytest.raises(ValueError, match=message) as error:
        make(hand)
    assert str(error.value).count(". ") == 0
