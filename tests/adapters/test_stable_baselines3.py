"""A learner of another library trains on a task of rewax."""

import jax
import numpy as np
import pytest
import seeing_toys
import toys

stable_baselines3 = pytest.importorskip("stable_baselines3", reason="pip install 'rewax[stable-baselines3]'")

from stable_baselines3.common import evaluation  # noqa: E402

import rewax  # noqa: E402
from benchmarks import stable_baselines as comparison  # noqa: E402
from rewax.adapters.gymnasium_env import GymnasiumEnv  # noqa: E402
from rewax.adapters.stable_baselines3 import StableBaselinesVecEnv  # noqa: E402
from rewax.agents.registry import algorithm  # noqa: E402
from rewax.envs.sensing import Sensing  # noqa: E402


def test_its_ppo_runs_on_rolling_flat():
    env = GymnasiumEnv(rewax.make("RollingFlat", scale="small"))
    learner = stable_baselines3.PPO("MultiInputPolicy", env, n_steps=32, batch_size=16, n_epochs=1, seed=0)
    before = [p.detach().numpy().copy() for p in learner.policy.parameters()]
    learner.learn(total_timesteps=64)
    assert learner.num_timesteps == 64
    assert any((a != b.detach().numpy()).any() for a, b in zip(before, learner.policy.parameters(), strict=True))
    action, _ = learner.predict(env.reset(seed=0)[0])
    assert np.isfinite(env.step(action)[1])


def test_its_ppo_learns_from_pictures_clouds_and_masks():
    env = Sensing(env=seeing_toys.visible(3), sensors=seeing_toys.each_kind())
    envs = StableBaselinesVecEnv(env, num_envs=2, seed=0)
    learner = stable_baselines3.PPO("MultiInputPolicy", envs, n_steps=4, batch_size=4, n_epochs=1, seed=0)
    learner.learn(total_timesteps=16)
    assert learner.num_timesteps == 16 and envs.observation_space.contains(
        {name: value[0] for name, value in envs.reset().items()}
    )


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
    policy = comparison.learner(name, config, env, 0, like_ours=False).policy
    theirs = sum(p.numel() for n, p in policy.named_parameters() if "target" not in n)
    state = algorithm(name).make(task, config).init(jax.random.key(0))
    ours = sum(a.size for a in jax.tree.leaves((state.actor_params, state.critic_params)))
    # PPO's policy there has a standard deviation apart from the network: one number for a head of 6 + 1.
    assert theirs == ours - (6 if name == "ppo" else 0)
    assert np.isfinite(list(comparison.theirs(name, task, task, config, [32, 64], 0, like_ours=False))).all()


def test_its_sac_trains_like_ours():
    changes = ["num_envs=4", "horizon=4", "batch_size=16", "updates=2", "warmup_steps=4", "max_grad_norm=1e-6"]
    config = comparison.changed(algorithm("sac").preset("Mine", "small"), changes)
    env = StableBaselinesVecEnv(toys.point_mass(), config.num_envs, flat=True)
    learner = comparison.learner("sac", config, env, 0, like_ours=True)
    weight = learner.critic.q_networks[0][-1].weight
    np.testing.assert_allclose(weight.norm().item(), config.initial_gain, rtol=1e-5)  # one orthogonal row
    target = learner.critic_target.q_networks[0][-1].weight
    np.testing.assert_array_equal(target.detach().numpy(), weight.detach().numpy())
    learner.learn(64)
    # The actor's: that of the critics has the actor's loss added after their update.
    norm = sum(float((p.grad**2).sum()) for p in learner.actor.parameters()) ** 0.5
    np.testing.assert_allclose(norm, 1e-6, rtol=1e-2)
    assert learner.ent_coef_optimizer.param_groups[0]["lr"] == config.temperature_learning_rate


def test_a_shifted_reward_is_the_reward_and_a_number():
    task = toys.point_mass()
    shifted = comparison.Shifted(env=task, by=np.float32(25.0))
    state, action = task.reset(jax.random.key(0)), np.ones(1, np.float32)
    difference = shifted.step(state, action).reward - task.step(state, action).reward
    np.testing.assert_allclose(difference, 25.0, rtol=1e-6)
    assert shifted.episode_length == task.episode_length


@pytest.mark.parametrize("flat", [False, True])
def test_its_ppo_runs_on_a_batch_and_logs_returns(flat):
    envs = StableBaselinesVecEnv(toys.point_mass(), 4, flat=flat)
    learner = stable_baselines3.PPO(
        "MlpPolicy" if flat else "MultiInputPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, seed=0
    )
    learner.learn(total_timesteps=128)
    assert learner.num_timesteps == 128 and len(learner.ep_info_buffer) == 4 * (128 // 4 // 5)
    assert np.isfinite([episode["r"] for episode in learner.ep_info_buffer]).all()


@pytest.mark.filterwarnings("error")
def test_its_evaluation_takes_the_returns_of_the_infos():
    envs = StableBaselinesVecEnv(toys.point_mass(), 2, flat=True)
    learner = stable_baselines3.PPO("MlpPolicy", envs, n_steps=8, batch_size=16, seed=0, device="cpu")
    returns, lengths = evaluation.evaluate_policy(learner, envs, n_eval_episodes=4, return_episode_rewards=True)
    assert lengths == [5] * 4 and len(set(returns)) == 4 and np.isfinite(returns).all()


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
