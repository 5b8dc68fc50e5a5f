"""A learner of another library trains on a task of rewax."""

import numpy as np
import pytest

stable_baselines3 = pytest.importorskip("stable_baselines3", reason="pip install 'rewax[stable-baselines3]'")

import rewax  # noqa: E402
from rewax.adapters.gymnasium_env import GymnasiumEnv  # noqa: E402


def test_its_ppo_runs_on_rolling_flat():
    env = GymnasiumEnv(rewax.make("RollingFlat", scale="small"))
    learner = stable_baselines3.PPO("MultiInputPolicy", env, n_steps=32, batch_size=16, n_epochs=1, seed=0)
    before = [p.detach().numpy().copy() for p in learner.policy.parameters()]
    learner.learn(total_timesteps=64)
    assert learner.num_timesteps == 64
    assert any((a != b.detach().numpy()).any() for a, b in zip(before, learner.policy.parameters(), strict=True))
    action, _ = learner.predict(env.reset(seed=0)[0])
    assert np.isfinite(env.step(action)[1])
