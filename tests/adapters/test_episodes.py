"""A batch as learners with their own loop expect it: auto-reset, infos of episodes that end, float32."""

import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.adapters.episodes import Episodes


class EndsBeyondTwo(toys.PointMass):
    """Terminates where |x| > 2."""

    def step(self, state, action):
        x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
        return self.after(state, x, terminated=jnp.abs(x[0]) > 2.0)


def test_a_whole_episode_reports_its_return_and_its_last_observation():
    envs = Episodes(toys.point_mass(5), 3)
    start, total = envs.reset(np.random.default_rng(0))["x"], np.zeros(3)
    for step in range(5):
        obs, rewards, done, infos = envs.step(np.full((3, 1), 0.1))
        total += rewards
        assert obs["x"].dtype == rewards.dtype == np.float32 and done.dtype == bool
        assert all(array.flags.writeable for array in (obs["x"], rewards, done))  # learners change them in place
        assert done.tolist() == [step == 4] * 3
        assert [info["TimeLimit.truncated"] for info in infos] == done.tolist()
        assert all(("terminal_observation" in info) == (step == 4) for info in infos)
    last = start + 5 * 0.1 * 0.5
    for i, info in enumerate(infos):
        np.testing.assert_allclose(info["terminal_observation"]["x"], last[i], rtol=1e-6)
        np.testing.assert_allclose(info["episode"]["r"], total[i], rtol=1e-6)
        assert info["episode"]["l"] == 5 and info["status"] == "OK"
        np.testing.assert_allclose(info["distance"], last[i, 0], rtol=1e-6)
    # The observation is already that of the next episode, and its return begins at 0.
    assert ((obs["x"] >= 0.5) & (obs["x"] <= 1.5)).all() and (obs["x"] != start).all()
    rewards = [envs.step(np.zeros((3, 1)))[1:] for _ in range(5)]
    np.testing.assert_allclose(
        [info["episode"]["r"] for info in rewards[-1][2]], np.sum([r for r, _, _ in rewards], axis=0), rtol=1e-6
    )


def test_an_episode_that_terminates_was_not_truncated():
    envs = Episodes(EndsBeyondTwo(gain=jnp.float32(1.5)), 2)
    x = envs.reset(np.random.default_rng(0))["x"]
    _, _, done, infos = envs.step(np.array([[1.0], [0.0]]))
    assert done.tolist() == [True, False] and not any(info["TimeLimit.truncated"] for info in infos)
    np.testing.assert_allclose(infos[0]["terminal_observation"]["x"], x[0] + 1.5, rtol=1e-6)
    assert set(infos[1]) == {"TimeLimit.truncated"}


@struct.dataclass
class SeesTwo(toys.PointMass):
    """It observes its place and a point cloud."""

    def reset(self, key):
        return self._seen(super().reset(key))

    def step(self, state, action):
        return self._seen(super().step(state.replace(obs={"x": state.obs["x"]}), action))

    def _seen(self, state):
        return state.replace(obs={**state.obs, "a": jnp.tile(state.obs["x"], (2, 3))})


def test_flat_observations_are_in_the_order_of_their_names():
    envs = Episodes(SeesTwo(gain=jnp.float32(0.5), length=1), 2, flat=True)
    obs = envs.reset(np.random.default_rng(0))
    assert obs.shape == (2, 7) and (obs == obs[:, :1]).all()
    _, _, _, infos = envs.step(np.zeros((2, 1)))
    np.testing.assert_array_equal(np.stack([info["terminal_observation"] for info in infos]), obs)


def test_what_cannot_be_is_refused():
    for num_envs in (0, True, 2.5, "3"):
        with pytest.raises(ValueError, match=r"num_envs is .*: give an integer of at least 1"):
            Episodes(toys.point_mass(), num_envs)
    with pytest.raises(ValueError, match=r"^env is None: give an environment"):
        Episodes(None, 2)
    envs = Episodes(toys.point_mass(), 2)
    with pytest.raises(ValueError, match="no episode has begun: call reset before step"):
        envs.step(np.zeros((2, 1)))
    envs.reset(np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"the action has shape \(2,\): give one of shape \(2, 1\)"):
        envs.step(np.zeros(2))
