"""What rigid tasks share, by a mass on a rail that is known by hand; draws of starts; every task's registration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rewax
from rewax import struct
from rewax.agents import sapo
from rewax.agents.presets import sapo_preset
from rewax.envs.kit.rigid_task import RigidTask, random_turn, uniform, xyzw
from rewax.envs.wrappers import AutoReset
from rewax.physics import rigid
from rewax.physics.rigid.spring_contacts import Penalty
from rewax.status import Status
from rewax.testing import check_env

MASS, GEAR, DT, NUM_SUBSTEPS, MAX_STEPS = 2.0, 4.0, 0.05, 2, 6
RAIL = f"""<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
<geom type="sphere" size="0.1" mass="{MASS}"/></body></worldbody>
<actuator><motor joint="x" gear="{GEAR}"/></actuator></mujoco>"""


@struct.dataclass
class Rail(RigidTask):
    """A mass on a rail that should get to a goal, drawn anew every step; over beyond x = 1."""

    def start(self, key):
        return rigid.initial_state(self.model, uniform(key, 1, 0.5)), jnp.zeros(1)

    def control(self, action):
        return 0.5 * action

    def observe(self, physics):
        return {"x": physics.rigid.qpos, "goal": physics.task}

    def reward(self, physics):
        x = physics.rigid.qpos[0]
        return x - 0.1 * physics.action[0] + physics.task[0], {"x": x}

    def terminated(self, physics):
        return physics.rigid.qpos[0] > 1.0

    def next_task(self, physics, key):
        return physics.rigid.qpos + uniform(key, 1, 1.0)


ENV = Rail(
    model=rigid.load(RAIL, dt=DT, penalty=Penalty(stiffness=1e3)), num_substeps=NUM_SUBSTEPS, max_steps=MAX_STEPS
)


@pytest.fixture(scope="module")
def step():
    return jax.jit(ENV.step)


@pytest.fixture(scope="module")
def start():
    return ENV.reset(jax.random.key(0))


def moved(x, v, force):
    """Place and velocity after a control step."""
    for _ in range(NUM_SUBSTEPS):
        v = v + DT * force / MASS
        x = x + DT * v
    return x, v


def at(state, x, v=0.0):
    bodies = state.physics.rigid.replace(qpos=jnp.array([x]), qvel=jnp.array([v]))
    return state.replace(physics=state.physics.replace(rigid=bodies))


@struct.dataclass
class Chasing(Rail):
    """Over when the goal that the reward sees is 0.25."""

    def terminated(self, physics):
        return physics.task[0] == 0.25


def test_reward_and_end_of_a_step_see_one_goal(start):
    env = Chasing(model=ENV.model, num_substeps=1, max_steps=MAX_STEPS)
    state = start.replace(physics=start.physics.replace(task=jnp.array([0.25])))
    new = jax.jit(env.step)(state, jnp.zeros(1))
    assert new.terminated and new.obs["goal"] != 0.25
    np.testing.assert_allclose(new.reward, new.physics.rigid.qpos[0] + 0.25, rtol=1e-6)


def test_it_is_an_environment():
    check_env(ENV)


def test_specs_come_from_model_and_observation():
    assert ENV.observation_spec == {"x": rewax.envs.base.ArraySpec((1,)), "goal": rewax.envs.base.ArraySpec((1,))}
    assert ENV.action_spec == rewax.envs.base.ArraySpec((1,), -1.0, 1.0)
    assert ENV.episode_length == MAX_STEPS and ENV.control_dt == pytest.approx(NUM_SUBSTEPS * DT)


@pytest.mark.parametrize(("action", "taken"), [(0.6, 0.6), (7.0, 1.0), (-3.0, -1.0)])
def test_an_action_is_clipped_turned_into_controls_and_kept(step, start, action, taken):
    state = step(at(start, 0.2, 0.3), jnp.array([action]))
    x, v = moved(0.2, 0.3, GEAR * 0.5 * taken)
    np.testing.assert_allclose(state.physics.rigid.qpos, [x], rtol=1e-6)
    np.testing.assert_allclose(state.physics.rigid.qvel, [v], rtol=1e-6)
    np.testing.assert_allclose(state.physics.action, [taken])
    assert float(state.metrics["x"]) == pytest.approx(x)


def test_the_reward_sees_the_task_before_it_changes_and_the_observation_after(step, start):
    state = step(at(start, 0.2), jnp.zeros(1))
    assert float(state.reward) == pytest.approx(0.2)  # the goal was 0
    goal = float(state.physics.task[0])
    assert goal != 0.0 and float(state.obs["goal"][0]) == goal and abs(goal - 0.2) < 1.0
    other = step(at(start.replace(key=jax.random.key(9)), 0.2), jnp.zeros(1))
    assert float(other.physics.task[0]) != goal
    again = step(state, jnp.zeros(1))
    assert float(again.reward) == pytest.approx(0.2 + goal)


def test_ends(step, start):
    state = at(start, 0.2)
    for count in range(1, MAX_STEPS + 1):
        state = step(state, jnp.zeros(1))
        assert bool(state.truncated) == (count == MAX_STEPS) and not bool(state.terminated)
    late = step(at(start.replace(step_count=jnp.int32(MAX_STEPS - 1)), 1.2), jnp.zeros(1))
    assert bool(late.terminated) and not bool(late.truncated)


def test_a_failure_ends_the_episode_without_touching_the_state(step, start):
    state = step(at(start, 0.2, jnp.inf), jnp.zeros(1))
    assert bool(state.terminated) and int(state.status) & Status.NAN and float(state.reward) == 0.0
    np.testing.assert_allclose(state.obs["x"], start.obs["x"])


def test_a_reset_cuts_the_gradient_of_the_episode_that_ended_and_of_no_other():
    env = AutoReset(env=ENV)
    first = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), 2))
    bodies = first.physics.rigid.replace(qpos=jnp.array([[1.0], [0.0]]), qvel=jnp.array([[1.0], [0.0]]))
    first = first.replace(physics=first.physics.replace(rigid=bodies))

    def rewards(actions):
        def body(states, action):
            states = jax.vmap(env.step)(states, action)
            return states, (states.reward, states.done)

        return jax.lax.scan(body, first, actions)[1]

    jacobian, done = jax.jit(jax.jacrev(rewards, has_aux=True))(jnp.zeros((3, 2, 1)))
    np.testing.assert_array_equal(done, [[True, False], [False, False], [False, False]])
    by_first = np.asarray(jacobian)[:, :, 0, :, 0]  # reward (step, env) by the first action of (env)
    assert by_first[0, 0, 0] > -0.1 + 1e-3  # its own step's reward: the push, less the cost
    np.testing.assert_array_equal(by_first[1:, 0, 0], 0.0)
    assert np.all(by_first[1:, 1, 1] > 0.01)
    np.testing.assert_array_equal(by_first[:, 0, 1], 0.0)
    np.testing.assert_array_equal(by_first[:, 1, 0], 0.0)


@pytest.mark.parametrize(
    ("gravity", "up"),
    [("0 0 -9.81", (0, 0, 1)), ("0 -3 0", (0, 1, 0)), ("-3 0 4", (0.6, 0, -0.8)), ("0 0 0", (0, 0, 1))],
)
def test_up_is_against_gravity(gravity, up):
    model = rigid.load(RAIL.replace('gravity="0 0 0"', f'gravity="{gravity}"'))
    np.testing.assert_allclose(ENV.replace(model=model).up, up, atol=1e-6)


def test_pictures_get_the_geoms():
    (shape,) = ENV.render_shapes(at(ENV.reset(jax.random.key(0)), 0.7).physics)
    assert shape["kind"] == "sphere" and float(shape["radius"]) == pytest.approx(0.1)
    np.testing.assert_allclose(shape["center"], [0.7, 0.0, 0.0], atol=1e-6)


def test_draws():
    keys = jax.random.split(jax.random.key(0), 4096)
    numbers = np.asarray(jax.vmap(lambda key: uniform(key, 2, 0.3))(keys))
    assert 0.299 < np.abs(numbers).max() <= 0.3 and np.abs(numbers.mean(axis=0)).max() < 0.015
    turns = np.asarray(jax.vmap(lambda key: random_turn(key, 0.4))(keys))
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1.0, rtol=1e-5)
    vectors = Rotation.from_quat(turns[:, [1, 2, 3, 0]]).as_rotvec()
    angle = np.linalg.norm(vectors, axis=1)
    assert 0.39 < angle.max() <= 0.4 + 1e-5 and angle.mean() == pytest.approx(0.2, rel=0.03)
    # Axes are those of points of a cube: along a diagonal more often than along an edge.
    axes = np.abs(vectors / angle[:, None])
    assert np.mean(axes.max(axis=1) < 0.7) > 1.5 * _share_of_sphere(0.7)
    np.testing.assert_array_equal(xyzw(jnp.arange(4.0)), [1.0, 2.0, 3.0, 0.0])


def _share_of_sphere(bound):
    """Share of directions none of whose components exceeds the bound."""
    points = np.random.default_rng(0).standard_normal((20_000, 3))
    return np.mean((np.abs(points) / np.linalg.norm(points, axis=1, keepdims=True)).max(axis=1) < bound)


@pytest.mark.parametrize("scale", ["paper", "small"])
@pytest.mark.parametrize("name", ["Ant", "AntRun", "CartpoleSwingUp", "HalfCheetah", "Hopper", "Humanoid", "Quadruped"])
def test_every_rigid_task_is_registered_with_a_preset_of_its_own(name, scale):
    env, preset = rewax.make(name, scale=scale), sapo_preset(name, scale)
    assert isinstance(env, RigidTask) and name in rewax.list_envs()
    assert preset != sapo_preset("no such task", scale)
    assert env.max_steps == {"paper": 1000, "small": 300}[scale] or name == "CartpoleSwingUp"
    if scale == "paper":
        assert (preset.num_envs, preset.horizon) == (64, 32)
        steps = preset.num_iterations * preset.num_envs * preset.horizon
        assert steps == pytest.approx(4.1e6 if name == "AntRun" else 10e6, rel=0.03)


def test_the_second_train_step_compiles_nothing():
    """Of SAPO on a rigid task: neither the step again nor an operation on the way to it."""
    small = {
        "actor_widths": (8,),
        "critic_widths": (8,),
        "vector_features": 8,
        "critic_passes": 1,
        "critic_minibatches": 1,
    }
    agent = sapo.make_sapo(ENV, sapo.SAPOConfig(num_envs=2, horizon=3, num_iterations=9, **small))
    state, _ = agent.train_step(agent.init(jax.random.key(0)))
    events = []
    jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: events.append(name))
    try:
        jax.jit(lambda x: x + 1.0)(jnp.zeros(7))
        assert any("compile" in name or "trace" in name for name in events)  # compiling is heard
        events.clear()
        state, _ = agent.train_step(state)
        jax.block_until_ready(state)
    finally:
        jax.monitoring.clear_event_listeners()
    assert events == [] and int(state.iteration) == 2
    assert agent.train_step._cache_size() == 1


def test_what_a_task_lacks_is_named():
    with pytest.raises(ValueError, match=r"num_substeps is 0, but must be an integer of at least 1: give"):
        ENV.replace(num_substeps=0)
    with pytest.raises(ValueError, match=r"max_steps is 2\.5, but must be an integer of at least 1"):
        ENV.replace(max_steps=2.5)
    with pytest.raises(NotImplementedError, match=r"RigidTask has no start\(key\): define it"):
        RigidTask(model=ENV.model, num_substeps=1, max_steps=1).reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"the action has shape \(2,\): give shape \(1,\)"):
        ENV.step(ENV.reset(jax.random.key(0)), jnp.zeros(2))


@pytest.mark.parametrize(
    ("method", "returned", "sentence"),
    [
        (
            "start",
            (jnp.zeros(1), jnp.zeros(1)),
            "start returned an array .* for the bodies, which must be a RigidState",
        ),
        ("control", None, "control returned None: return one number for each actuator"),
        ("terminated", jnp.zeros(1, bool), r"terminated returned an array of bool of shape \(1,\): return one boolean"),
        ("next_task", jnp.zeros(2), r"next_task returned shape \(2,\) after \(1,\): keep the shape"),
        ("observe", {"x": None}, r"observe\(physics\)\['x'\] is None, which is no array of real numbers: return real"),
        ("reward", (1.0, {"x": "a"}), r"reward\(physics\)\[1\]\['x'\] is 'a', which is no array of real numbers"),
    ],
)
def test_what_a_method_returns_wrongly_is_named(method, returned, sentence, monkeypatch):
    monkeypatch.setattr(Rail, method, lambda self, *_: returned)
    with pytest.raises(ValueError, match=rf"^Rail\.{sentence}"):
        jax.eval_shape(lambda key: ENV.step(ENV.reset(key), jnp.zeros(1)), jax.random.key(0))


def test_lists_are_as_good_as_arrays(start, step):
    np.testing.assert_array_equal(ENV.step(start, [0.5]).obs["x"], step(start, jnp.array([0.5])).obs["x"])


def test_numerical_failure_is_what_the_check_names():
    stiff = rigid.load(
        RAIL.replace("<joint ", '<joint range="-0.1 0.1" '), dt=DT, penalty=Penalty(stiffness=1e3, limit_stiffness=1e12)
    )
    with pytest.raises(AssertionError, match=r"^the first step sets the status NAN: give shorter substeps or softer"):
        check_env(Rail(model=stiff, num_substeps=NUM_SUBSTEPS, max_steps=MAX_STEPS), check_full_episode=False)


def test_actions_span_the_range_of_limited_controls():
    text = RAIL.replace("</actuator>", '<motor joint="x" ctrlrange="0 3"/></actuator>')
    env = Rail(model=rigid.load(text), num_substeps=1, max_steps=1)
    control = jax.vmap(lambda action: RigidTask.control(env, action))(jnp.array([[-1.0, -1.0], [0.0, 0.0], [0.7, 1.0]]))
    np.testing.assert_allclose(control, [[-1.0, 0.0], [0.0, 1.5], [0.7, 3.0]], rtol=1e-6)
