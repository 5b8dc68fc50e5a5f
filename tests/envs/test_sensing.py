"""Sensors on environments: physics stays as it is, observations are added, pictures show what happens."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import seeing_toys
import toys

import rewax
from rewax import struct
from rewax.envs.base import failed_leaf_name
from rewax.envs.history import History
from rewax.envs.latency import Latency
from rewax.envs.randomize import Constant, hook
from rewax.envs.randomized import Randomized
from rewax.envs.sensing import Sensing
from rewax.envs.wrappers import AutoReset
from rewax.sensors import Camera, DepthCloud, DepthNoise, Labels
from rewax.status import Status
from rewax.testing import check_env

CAMERA = Camera.look_at((-1.0, 0.0, -0.2), eye=(-1.0, -2.0, 0.3), up=(0, 0, 1), near=0.5, far=4.0, height=24, width=32)


@pytest.fixture(scope="module")
def bare():
    return rewax.make("CartpoleSwingUp", scale="small")


@pytest.fixture(scope="module")
def sensing(bare):
    return Sensing(env=bare, sensors={"depth": CAMERA, "noisy": CAMERA.replace(noise=DepthNoise(constant=0.05))})


@pytest.fixture(scope="module")
def steps(bare, sensing):
    """States with and without sensors after a reset and two control steps."""
    actions = jnp.full((2, *bare.action_spec.shape), 0.7)

    def run(env, key):
        first = env.reset(key)
        _, rest = jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, first, actions)
        return first, rest

    return jax.jit(run)(bare, jax.random.key(3)), jax.jit(run)(sensing, jax.random.key(3))


def test_sensors_change_nothing_but_the_observations(steps):
    for without, seeing in zip(*steps, strict=True):
        np.testing.assert_array_equal(jax.random.key_data(without.key), jax.random.key_data(seeing.key))
        for name in ("physics", "reward", "step_count", "status"):
            jax.tree.map(np.testing.assert_array_equal, getattr(without, name), getattr(seeing, name))
        for name, value in without.obs.items():
            np.testing.assert_array_equal(value, seeing.obs[name])
        assert set(seeing.obs) == {*without.obs, "depth", "noisy"}


def test_the_picture_moves_with_the_cart_and_noise_is_drawn_anew(steps):
    first, rest = steps[1]
    assert first.obs["depth"].shape == (24, 32, 1) and (first.obs["depth"] < 1).sum() > 20
    assert np.abs(rest.obs["depth"][1] - first.obs["depth"]).max() > 0.1
    pictures = [first.obs, *(jax.tree.map(lambda a, i=i: a[i], rest.obs) for i in range(2))]
    errors = [np.asarray(o["noisy"] - o["depth"]) for o in pictures]
    in_all = np.all([np.asarray(o["depth"]) < 1 for o in pictures], axis=0)
    assert in_all.sum() > 10 and all(0.002 < e[in_all].std() < 0.03 for e in errors)
    assert (np.abs(errors[0] - errors[1])[in_all] > 1e-4).mean() > 0.9
    assert (np.abs(errors[1] - errors[2])[in_all] > 1e-4).mean() > 0.9


def test_the_specification_has_what_sensors_see(bare, sensing):
    spec = sensing.observation_spec
    assert spec["depth"].shape == (24, 32, 1) and {**spec, **bare.observation_spec} == spec
    assert sensing.action_spec == bare.action_spec and sensing.episode_length == bare.episode_length


def test_the_text_of_a_wrapped_task_names_what_it_observes(bare, sensing):
    drawn = Randomized(env=sensing, randomize=lambda key, env: env)
    assert repr(drawn).startswith("Randomized(env=Sensing(observation={'")
    assert (
        "'depth': (24, 32, 1)" in repr(drawn) and repr(drawn).count("observation=") == 2
    )  # the camera's and the task's
    assert repr(AutoReset(env=bare)) == f"AutoReset(env={bare!r})"  # it observes the same


def test_a_wrapped_task_has_the_control_step_of_the_task(bare, sensing):
    assert AutoReset(env=Randomized(env=sensing, randomize=lambda key, env: env)).control_dt == bare.control_dt
    assert not hasattr(AutoReset(env=toys.point_mass()), "control_dt")


def test_a_cameras_place_is_a_parameter_of_the_environment(sensing):
    moved = sensing.replace(sensors={**sensing.sensors, "depth": CAMERA.replace(position=CAMERA.position + 0.3)})
    see = jax.jit(lambda env: env.reset(jax.random.key(0)).obs["depth"])
    assert np.abs(see(moved) - see(sensing)).max() > 0.1


def test_after_an_episode_the_final_picture_is_kept(bare):
    env = AutoReset(env=Sensing(env=bare.replace(max_steps=2), sensors={"depth": CAMERA}))

    def run(key):
        state = env.reset(key)
        return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, state, jnp.ones((3, *bare.action_spec.shape)))[1]

    state = jax.jit(run)(jax.random.key(0))
    assert state.done.tolist() == [False, True, False]
    same = [bool((state.final_obs["depth"][i] == state.obs["depth"][i]).all()) for i in range(3)]
    assert same == [True, False, True]


def test_pictures_clouds_and_masks_pass_the_check():
    """check_env compares them with their spec, with repeats, without jit and side by side."""
    env = Sensing(env=seeing_toys.visible(), sensors=seeing_toys.each_kind())
    assert set(env.observation_spec) == {"x", "depth", "noisy", "labels", "cloud"}
    check_env(env, notify=None)


def test_bad_sensors_are_refused(bare):
    with pytest.raises(ValueError, match="sensors has 'state', which the environment observes already"):
        Sensing(env=bare, sensors={"state": CAMERA})
    with pytest.raises(ValueError, match=r"sensors\['x'\] is 3.*see\(world, key\)"):
        Sensing(env=bare, sensors={"x": 3})
    with pytest.raises(ValueError, match="sensors has 'state', which the environment observes already"):
        Sensing(env=bare, sensors={"state": CAMERA}, up=(0.0, 1.0, 0.0))
    with pytest.raises(ValueError, match=r"up is \(0.0, 2.0, 0.0\): give a unit vector"):
        Sensing(env=bare, sensors={"depth": CAMERA}, up=(0.0, 2.0, 0.0))
    with pytest.raises(ValueError, match="has no world"):
        Sensing(env=object(), sensors={"depth": CAMERA})
    with pytest.raises(ValueError, match=r"sensors\['x'\] is of the class Plain, which is no pytree: decorate it"):
        Sensing(env=bare, sensors={"x": Plain()})


@pytest.mark.parametrize("sensors", [("a",), None, {3: CAMERA}], ids=str)
def test_sensors_without_names_are_refused(bare, sensors):
    with pytest.raises(ValueError, match=r"^sensors is .*: give them by name, "):
        Sensing(env=bare, sensors=sensors)


@pytest.mark.parametrize("up", ["y", (0.0, 1.0), (True, False, False), (0.0, 0.0, float("nan"))], ids=str)
def test_a_direction_upwards_is_a_unit_vector(bare, up):
    with pytest.raises(ValueError, match=r"^up is .*: give a unit vector against gravity"):
        Sensing(env=bare, up=up)


@struct.dataclass
class Returning(struct.Replaceable):
    """A sensor that observes a constant."""

    value: object = struct.static_field()

    def see(self, world, key):
        return self.value


@struct.dataclass
class Keyless(struct.Replaceable):
    """A sensor that asks for no key."""

    def see(self, world):
        return world


@pytest.mark.parametrize("value", ["a", None, 1j, (None,)], ids=str)
def test_a_sensor_returns_numbers(value):
    env = Sensing(env=seeing_toys.visible(), sensors={"a": Returning(value=value)})
    with pytest.raises(ValueError, match=r"^sensors\['a'\]\.see\(world, key\) is .*: return an array of real numbers"):
        env.reset(jax.random.key(0))


def test_a_sensor_takes_a_world_and_a_key_and_may_return_a_python_number():
    with pytest.raises(ValueError, match=r"^sensors\['a'\].see takes \(world\): let it take \(world, key\)"):
        Sensing(env=seeing_toys.visible(), sensors={"a": Keyless()})
    state = Sensing(env=seeing_toys.visible(), sensors={"a": Returning(value=2.0)}).reset(jax.random.key(0))
    assert state.obs["a"] == 2.0


def test_a_state_without_what_sensors_see_is_refused():
    env = seeing_toys.sensing()
    with pytest.raises(ValueError, match=r"^the state is not of this Sensing: begin with reset of the Sensing"):
        env.step(env.env.reset(jax.random.key(0)), jnp.zeros(1))


class Plain:
    def see(self, world, key):
        raise AttributeError("the sensor's own mistake")


@struct.dataclass
class Mistaken(struct.Replaceable, Plain):
    """A sensor that fails."""


def test_an_error_of_a_sensor_is_not_hidden(bare):
    with pytest.raises(AttributeError, match="the sensor's own mistake"):
        _ = Sensing(env=bare, sensors={"x": Mistaken()}).observation_spec


def test_lists_arrays_and_numpys_numbers_are_as_good_as_tuples_and_numbers(bare):
    camera = CAMERA.replace(height=np.int64(8), width=np.int64(8))
    sensors = {
        "cloud": DepthCloud(camera=camera, num_points=np.int64(4), of=["ball"]),
        "mask": Labels(camera=camera, of=["ball"]),
    }
    env = Sensing(env=bare, sensors=sensors, up=np.array([0.0, 1.0, 0.0]))
    assert env.up == (0.0, 1.0, 0.0) and hash(jax.tree.structure(env)) == hash(jax.tree.structure(env.replace()))


@struct.dataclass
class Sized(seeing_toys.Visible):
    """The ball's radius is a parameter."""

    radius: float = struct.field(default=0.2)

    def world(self, physics, up):
        seen = super().world(physics, up)
        ball, floor = seen.solids
        return seen.replace(solids=(ball.replace(shape=ball.shape.replace(radius=self.radius)), floor))


def test_a_camera_around_drawn_parameters_sees_what_was_drawn():
    env, camera = Sized(gain=jnp.float32(0.5)), {"depth": seeing_toys.front_camera()}
    inside = Sensing(env=Randomized(env=env, randomize=hook({"radius": Constant(0.4)})), sensors=camera)
    drawn = inside.reset(jax.random.key(0))
    large = Sensing(env=env.replace(radius=0.4), sensors=camera)
    for state in (drawn, inside.step(drawn, jnp.ones(1))):
        np.testing.assert_array_equal(state.obs["depth"], large._see(state)["depth"])
    small = Sensing(env=env, sensors=camera)._see(drawn)
    assert np.abs(drawn.obs["depth"] - small["depth"]).max() > 0.1


@struct.dataclass
class Slope(struct.Replaceable):
    """Square root of the ball's place relative to ``edge``: not a number left of it."""

    edge: float

    def see(self, world, key):
        return jnp.sqrt(world.solids[0].pose.position[0] - self.edge)


def test_a_step_in_which_a_sensor_sees_no_number_fails():
    env = Sensing(env=seeing_toys.visible(), sensors={"slope": Slope(edge=-0.2)})
    first = env.reset(jax.random.key(0))
    left = first.replace(physics=jnp.full_like(first.physics, -0.1))
    good, bad = (jax.jit(env.step)(left, jnp.array([push])) for push in (0.0, -1.0))
    assert good.status == Status.OK and not good.terminated and good.obs["slope"] == pytest.approx(0.1**0.5, rel=1e-5)
    assert bad.status == Status.NAN and bad.terminated and not bad.truncated and bad.reward == 0.0
    assert bad.obs["slope"] == left.obs["slope"] and bad.obs["x"] != left.obs["x"]
    assert failed_leaf_name(env, int(bad.failed_leaf)) == "the observation of a sensor"
    assert failed_leaf_name(env, int(good.failed_leaf)) == "nothing"


def test_a_reset_in_which_a_sensor_sees_no_number_says_so_and_its_first_step_fails():
    env = Sensing(env=seeing_toys.visible(), sensors={"slope": Slope(edge=100.0)})
    first = env.reset(jax.random.key(0))
    assert first.status == Status.NAN and not first.done
    assert failed_leaf_name(env, int(first.failed_leaf)) == "the observation of a sensor"
    near = first.replace(physics=jnp.full_like(first.physics, 0.1))
    sees = Sensing(env=seeing_toys.visible(), sensors={"slope": Slope(edge=-9.0)})
    after = sees.step(near, jnp.zeros(1))  # a number now, but the action came from none
    assert after.status == Status.NAN and after.terminated and after.reward == 0.0


def test_sensors_around_sensors_draw_their_own_noise():
    camera = seeing_toys.front_camera(noise=DepthNoise(constant=0.1))
    inner = Sensing(env=seeing_toys.visible(), sensors={"a": camera})
    obs = Sensing(env=inner, sensors={"b": camera}).reset(jax.random.key(0)).obs
    assert (obs["a"] != obs["b"]).mean() > 0.3
    np.testing.assert_array_equal(obs["a"], inner.reset(jax.random.key(0)).obs["a"])


def test_the_array_of_a_failure_keeps_its_name_behind_sensors():
    class Failing(seeing_toys.Visible):
        def step(self, state, action):
            return self.after(state, state.physics, status=int(Status.NAN))

    env = Failing(gain=jnp.float32(0.5))
    failed = env.step(env.reset(jax.random.key(0)), jnp.ones(1)).failed_leaf
    camera = seeing_toys.front_camera()
    assert failed_leaf_name(Sensing(env=env, sensors={"depth": camera, "y": camera}), int(failed)) == "status"


def test_a_wrapped_environment_is_not_the_one_that_make_built():
    """Else a run would be described, and loaded, without what is wrapped around."""
    env = rewax.make("CartpoleSwingUp", scale="small")
    assert env.made_by["env"] == "CartpoleSwingUp"
    for wrapped in (History(env=env), Latency(env=env), Sensing(env=env, sensors={})):
        assert not hasattr(wrapped, "made_by") and wrapped.appearance == env.appearance
