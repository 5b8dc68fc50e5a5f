"""gymnasium's own checker, and the same numbers as the environment itself."""

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import recordings
import seeing_toys
from toys import PointMass, point_mass, subprocess_environment

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'rewax[gymnasium]'")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import rewax  # noqa: E402
from rewax import struct  # noqa: E402
from rewax.adapters import gymnasium_ids  # noqa: E402
from rewax.adapters.gymnasium_env import GymnasiumEnv, GymnasiumVectorEnv  # noqa: E402
from rewax.envs.sensing import Sensing  # noqa: E402
from rewax.envs.wrappers import AutoReset, Vmap  # noqa: E402


class EndsBeyondTwo(PointMass):
    """Terminates where |x| > 2."""

    def step(self, state, action):
        x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
        return self.after(state, x, terminated=jnp.abs(x[0]) > 2.0)


@pytest.mark.filterwarnings("ignore:.*Box.*infinity:UserWarning", "ignore:.*render.*:UserWarning")
def test_gymnasiums_checker_passes():
    check_env(GymnasiumEnv(point_mass()), skip_render_check=True)


@pytest.mark.filterwarnings("ignore:.*Box.*infinity:UserWarning", "ignore:.*render.*:UserWarning")
def test_gymnasiums_checker_passes_with_pictures_clouds_and_masks():
    env = Sensing(env=seeing_toys.visible(3), sensors=seeing_toys.each_kind())
    seen = GymnasiumEnv(env)
    check_env(seen, skip_render_check=True)
    spaces = seen.observation_space
    for name, shape in (("depth", (24, 32, 1)), ("labels", (24, 32, 2))):
        assert spaces[name].shape == shape and (spaces[name].low == 0).all() and (spaces[name].high == 1).all()
    assert spaces["noisy"].low.min() == np.float32(-1.0 / 3.0) and spaces["cloud"].shape == (8, 3)
    many = GymnasiumVectorEnv(env, 2)
    obs, _ = many.reset(seed=0)
    for _ in range(4):  # beyond the end of an episode
        assert many.observation_space.contains(obs)
        obs, *_ = many.step(np.ones((2, 1), np.float32))


def test_an_episode_is_that_of_the_environment():
    env = GymnasiumEnv(point_mass(length=3))
    obs, info = env.reset(seed=1)
    x = obs["x"]
    assert obs["x"].dtype == np.float32 and info["status"] == "OK"
    for step in range(3):
        obs, reward, terminated, truncated, info = env.step(np.array([0.5]))
        x = x + 0.5 * 0.5
        np.testing.assert_allclose(obs["x"], x, rtol=1e-6)
        np.testing.assert_allclose([reward, info["distance"]], [-(x[0] ** 2), x[0]], rtol=1e-6)
        assert (terminated, truncated) == (False, step == 2)
    again, _ = env.reset(seed=1)
    other, _ = env.reset()
    assert again["x"] == pytest.approx(x - 0.75) and other["x"] != again["x"]


@pytest.mark.parametrize(
    ("size", "sentence"),
    [
        ((0, -1), r"size\[0\] is 0, but must be an integer of at least 1: give height and width in pixels"),
        ((9, 1.5), r"size\[1\] is 1.5, but must be an integer of at least 1: give height and width in pixels"),
        (64, "size is 64: give height and width in pixels"),
    ],
)
def test_a_picture_has_pixels(size, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        GymnasiumEnv(point_mass(), render_mode="rgb_array", size=size)


def test_a_name_is_no_environment():
    for make in (GymnasiumEnv, lambda env: GymnasiumVectorEnv(env, 2)):
        with pytest.raises(ValueError, match=r"^env is 'RollingFlat': give an environment, rewax.make"):
            make("RollingFlat")


def test_a_task_ends_itself():
    env = GymnasiumEnv(EndsBeyondTwo(gain=jnp.float32(3.0)))
    env.reset(seed=0)
    _, _, terminated, truncated, _ = env.step(np.ones(1))
    assert terminated and not truncated


def test_environments_that_begin_anew_and_batches_are_refused():
    with pytest.raises(ValueError, match="has AutoReset: give it without"):
        GymnasiumEnv(AutoReset(env=point_mass()))
    with pytest.raises(ValueError, match="has Vmap: give one environment"):
        GymnasiumEnv(Vmap(env=point_mass()))


@pytest.mark.parametrize(
    ("action", "message"),
    [(np.zeros(2), r"shape \(2,\): give one of shape \(1,\)"), ([np.nan], "not finite: check the policy")],
)
def test_wrong_actions(action, message):
    env = GymnasiumEnv(point_mass())
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(action)


def test_step_before_reset():
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
        GymnasiumEnv(point_mass()).step(np.zeros(1))
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
        GymnasiumVectorEnv(point_mass(), 2).step(np.zeros((2, 1)))


def test_many_at_once_begin_anew_in_the_step_that_ends_an_episode():
    envs = GymnasiumVectorEnv(point_mass(length=2), num_envs=3)
    first, infos = envs.reset(seed=[1, 2, 1])
    assert first["x"][0] == first["x"][2] != first["x"][1] and infos["_distance"].all()
    assert envs.observation_space.contains(first)
    actions = np.full((3, 1), 0.5, np.float32)
    _, _, _, _, infos = envs.step(actions)
    assert "final_obs" not in infos
    obs, rewards, terminated, truncated, infos = envs.step(actions)
    last = first["x"] + 0.5
    np.testing.assert_allclose(rewards, -(last[:, 0] ** 2), rtol=1e-6)
    assert truncated.all() and not terminated.any() and infos["_final_obs"].all()
    np.testing.assert_allclose([o["x"] for o in infos["final_obs"]], last, rtol=1e-6)
    np.testing.assert_allclose(infos["final_info"]["distance"], last[:, 0], rtol=1e-6)
    assert ((obs["x"] >= 0.5) & (obs["x"] <= 1.5)).all() and (obs["x"] != first["x"]).all()


def test_only_environments_that_end_report_their_end():
    envs = GymnasiumVectorEnv(EndsBeyondTwo(gain=jnp.float32(1.5)), num_envs=2)
    x = envs.reset(seed=0)[0]["x"]
    assert ((x > 0.5) & (x < 1.5)).all()
    _, _, terminated, _, infos = envs.step(np.array([[1.0], [0.0]]))
    assert terminated.tolist() == [True, False]
    assert infos["_distance"].tolist() == infos["_status"].tolist() == [False, True]  # a new episode has no step yet
    assert infos["final_obs"][1] is None and infos["final_info"]["_distance"].tolist() == [True, False]
    np.testing.assert_allclose(infos["final_obs"][0]["x"], x[0] + 1.5, rtol=1e-6)


def test_gymnasiums_wrappers_and_vector_wrappers_work():
    env = gymnasium.wrappers.FlattenObservation(GymnasiumEnv(point_mass()))
    assert env.reset(seed=0)[0].shape == (1,)
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(GymnasiumVectorEnv(point_mass(length=2), 2))
    envs.reset(seed=0)
    actions = np.zeros((2, 1))
    rewards = envs.step(actions)[1] + (end := envs.step(actions))[1]
    np.testing.assert_allclose(end[4]["episode"]["r"], rewards, rtol=1e-6)


def test_wrong_numbers_of_environments_and_seeds():
    for num_envs in (0, "3", True):
        with pytest.raises(ValueError, match=r"num_envs is .*: give an integer of at least 1"):
            GymnasiumVectorEnv(point_mass(), num_envs)
    with pytest.raises(ValueError, match="2 seeds for 3 environments"):
        GymnasiumVectorEnv(point_mass(), 3).reset(seed=[0, 1])


def test_seeds_may_be_left_open_and_a_mask_is_refused():
    envs = GymnasiumVectorEnv(point_mass(), 2)
    first, second = (envs.reset(seed=[7, None])[0]["x"] for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1] != second[1]
    with pytest.raises(ValueError, match="reset_mask is given, but environments that end begin anew by themselves"):
        envs.reset(options={"reset_mask": np.array([True, False])})


def test_the_same_seed_gives_the_same_numbers_as_jax():
    env = point_mass()
    adapted = GymnasiumEnv(env)
    obs, _ = adapted.reset(seed=5)
    key = jax.random.key(int(np.random.Generator(np.random.PCG64(np.random.SeedSequence(5))).integers(2**31)))
    np.testing.assert_array_equal(obs["x"], env.reset(key).obs["x"])


def test_pictures_change_with_the_state():
    env = GymnasiumEnv(point_mass(), render_mode="rgb_array", size=(48, 64))
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before render"):
        env.render()
    env.reset(seed=0)
    before = env.render()
    env.step(np.ones(1))
    after = env.render()
    assert before.shape == after.shape == (48, 64, 3) and before.dtype == np.uint8
    assert before.std() > 0.0 and (before != after).any()
    assert GymnasiumEnv(point_mass()).render() is None
    with pytest.raises(ValueError, match="render_mode is 'human': give 'rgb_array' or None"):
        GymnasiumEnv(point_mass(), render_mode="human")


def test_a_picture_shows_a_robot_that_has_run_away():
    env = GymnasiumEnv(point_mass(), render_mode="rgb_array", size=(48, 64))
    env.reset(seed=0)
    run = recordings.moving_ball(2, travel=30.0)
    at = iter([0, 1, 0])
    env._record = lambda states: run.take([next(at)])
    first, far = env.render(), env.render()
    middle = np.s_[16:32, 24:40]  # within the ball
    assert np.abs(first.astype(int) - far)[middle].mean() < 1.0 < np.abs(first.astype(int) - far).mean()
    env.reset(seed=0)  # the camera knows nothing of the last episode
    np.testing.assert_array_equal(env.render(), first)


def test_every_task_has_a_name_for_gymnasium():
    assert list(gymnasium_ids.TASKS) == [name for name in rewax.list_envs() if name in gymnasium_ids.TASKS]
    shipped = [line.split('"')[1] for line in Path(rewax.envs.__file__).read_text().splitlines() if "register(" in line]
    assert sorted(shipped) == list(gymnasium_ids.TASKS)
    for name in shipped:
        for scale in gymnasium_ids.SCALES:
            assert f"rewax/{name}-{scale}-v0" in gymnasium.registry


def test_gymnasium_makes_a_task_by_its_name():
    env = gymnasium.make("rewax/CartpoleSwingUp-small-v0", num_substeps=8)
    assert env.unwrapped.env.num_substeps == 8 and env.unwrapped.env.made_by["scale"] == "small"
    assert env.observation_space["state"].shape == (5,)
    envs = gymnasium.make_vec("rewax/CartpoleSwingUp-small-v0", num_envs=2)
    assert isinstance(envs.unwrapped, GymnasiumVectorEnv) and envs.num_envs == 2


def test_the_entry_point_imports_no_jax():
    code = "import sys, gymnasium\nfrom rewax.adapters.gymnasium_ids import register_envs\nregister_envs()\nregister_envs()\n"
    code += "print('jax' in sys.modules, 'rewax/RollingFlat-paper-v0' in gymnasium.registry)"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        env=subprocess_environment(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["False", "True"]
    entry = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]["entry-points"]
    module, function = entry["gymnasium.envs"]["rewax"].split(":")
    assert getattr(importlib.import_module(module), function) is gymnasium_ids.register_envs


def test_observations_of_other_types_become_float32():
    @struct.dataclass
    class Counting(struct.Replaceable):
        def see(self, world, key):
            return jnp.arange(3)

    env = GymnasiumEnv(Sensing(env=seeing_toys.visible(3), sensors={"count": Counting()}))
    obs, _ = env.reset(seed=0)
    assert obs["count"].dtype == np.float32 and env.observation_space.contains(obs)


def test_a_batch_may_be_flat():
    """In the order of gymnasium's own flattening."""
    envs, flat = (GymnasiumVectorEnv(point_mass(length=2), 2, flat=flat) for flat in (False, True))
    assert flat.observation_space.shape == (2, 1) and flat.single_observation_space.shape == (1,)
    obs, vectors = envs.reset(seed=3)[0], flat.reset(seed=3)[0]
    np.testing.assert_array_equal(
        vectors[0], gymnasium.spaces.flatten(envs.single_observation_space, {"x": obs["x"][0]})
    )
    flat.step(np.zeros((2, 1)))
    end = flat.step(np.zeros((2, 1)))
    assert flat.observation_space.contains(end[0]) and end[4]["final_obs"][1].shape == (1,)


def test_resets_after_a_list_of_seeds_repeat():
    envs = [GymnasiumVectorEnv(point_mass(), 2) for _ in range(2)]
    again = [(env.reset(seed=[1, 2]), env.reset())[1][0]["x"] for env in envs]
    np.testing.assert_array_equal(*again)
