"""A learner of another library trains on a task of rewax."""

import jax
import numpy as np
import pytest
import toys

stable_baselines3 = pytest.importorskip("stable_baselines3", reason="pip install 'rewax[stable-baselines3]'")

import rewax  # noqa: E402
from benchmarks import stable_baselines as comparison  # noqa: E402
from rewax.adapters.gymnasium_env import GymnasiumEnv  # noqa: E402
from rewax.adapters.stable_baselines3 import StableBaselinesVecEnv  # noqa: E402
from rewax.agents.registry import algorithm  # noqa: E402


def test_its_ppo_runs_on_rolling_flat():
    env = GymnasiumEnv(rewax.make("RollingFlat", scale="small"))
    learner = stable_baselines3.PPO("MultiInputPolicy", env, n_steps=32, batch_size=16, n_epochs=1, seed=0)
    before = [p.detach().numpy().copy() for p in learner.policy.parameters()]
    learner.learn(total_timesteps=64)
    assert learner.num_timesteps == 64
    assert any((a != b.detach().numpy()).any() for a, b in zip(before, learner.policy.parameters(), strict=True))
    action, _ = learner.predict(env.reset(seed=0)[0])
    assert np.isfinite(env.step(action)[1])


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_the_benchmark_gives_it_the_layers_of_rewax(name):
    config = comparison.changed(
        algorithm(name).preset("Mine", "small"),
        [
            "num_envs=4",
            "horizon=4",
            "actor_widths=(8, 6)",
            "critic_widths=(5,)",
            "vector_features=3",
            "quick_compile=False",
        ],
    )
    changes = ["minibatches=1", "epochs=1"] if name == "ppo" else ["batch_size=16", "updates=2", "warmup_steps=4"]
    config, task = comparison.changed(config, changes), toys.point_mass()
    env = StableBaselinesVecEnv(task, config.num_envs, flat=True)
    policy = comparison.learner(name, config, env, 0).policy
    theirs = sum(p.numel() for n, p in policy.named_parameters() if "target" not in n)
    state = algorithm(name).make(task, config).init(jax.random.key(0))
    ours = sum(a.size for a in jax.tree.leaves((state.actor_params, state.critic_params)))
    # PPO's policy there has a standard deviation apart from the network: one number for a head of 6 + 1.
    assert theirs == ours - (6 if name == "ppo" else 0)
    assert np.isfinite(comparison.theirs(name, task, config, [32, 64], 0)).all()


@pytest.mark.parametrize("flat", [False, True])
def test_its_ppo_runs_on_a_batch_and_logs_returns(flat):
    envs = StableBaselinesVecEnv(toys.point_mass(), 4, flat=flat)
    learner = stable_baselines3.PPO(
        "MlpPolicy" if flat else "MultiInputPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, seed=0
    )
    learner.learn(total_timesteps=128)
    assert learner.num_timesteps == 128 and len(learner.ep_info_buffer) == 4 * (128 // 4 // 5)
    assert np.isfinite([episode["r"] for episode in learner.ep_info_buffer]).all()


def test_a_seed_gives_the_same_episodes():
    envs = StableBaselinesVecEnv(toys.point_mass(), 3, seed=7)
    first, second = envs.reset()["x"], envs.reset()["x"]
    envs.seed(7)
    assert (first != second).all()
    np.testing.assert_array_equal(envs.reset()["x"], first)


def test_it_answers_what_stable_baselines3_asks():
    env = toys.point_mass()
    envs = StableBaselinesVecEnv(env, 3)
    assert envs.get_attr("episode_length", [0, 2]) == [5, 5] and envs.env_is_wrapped(object) == [False] * 3
    assert envs.render_mode is None and not envs.has_attr("nothing")
    with pytest.raises(AttributeError, match="environments of rewax are immutable"):
        envs.set_attr("length", 3)
