"""Runs from their directories: the same policy, and sentences where there is none to build."""

import json

import jax
import numpy as np
import pytest
import toys

from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.envs import registry
from rewax.training.checkpoint import write_config
from rewax.training.config import TrainConfig
from rewax.training.loop import train
from rewax.training.saved import load_run

CONFIG = SAPOConfig(
    num_envs=2, horizon=3, num_iterations=2, critic_passes=1, critic_minibatches=1, actor_widths=(4, 4), critic_widths=(4,), vector_features=4,
)  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run, its environment registered, and what training returned."""
    run_dir = tmp_path_factory.mktemp("run")
    registry._FACTORIES["PointMass"] = lambda scale: toys.point_mass(5 if scale == "small" else 7)
    env = registry.make("PointMass", scale="paper")
    quick = {"num_eval_episodes": 2, "plots": False, "baselines": False, "tensorboard": False}
    config = TrainConfig(num_iterations=2, run_dir=str(run_dir), checkpoint_every=1, **quick)
    describe = {"env": "PointMass", "scale": "paper", "agent": "sapo", "sapo": CONFIG}
    yield run_dir, train(make_sapo(env, CONFIG), env, config, describe=describe).train_state
    del registry._FACTORIES["PointMass"]


def test_the_policy_is_the_one_that_was_trained(run):
    run_dir, train_state = run
    saved = load_run(run_dir)
    assert saved.env.episode_length == 7 and saved.config["sapo"]["horizon"] == 3
    obs, key = saved.env.reset(jax.random.key(1)).obs, jax.random.key(2)
    for deterministic in (True, False):
        actions = [
            saved.agent.policy(state, obs, key, deterministic=deterministic)
            for state in (saved.train_state, train_state)
        ]
        np.testing.assert_array_equal(*actions)
    assert [int(load_run(run_dir, step=step).train_state.iteration) for step in (1, 2)] == [1, 2]


def test_what_cannot_be_built_is_said(run, tmp_path):
    run_dir, _ = run
    with pytest.raises(ValueError, match="nowhere holds no complete checkpoint: check the path"):
        load_run(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="no checkpoint of iteration 5"):
        load_run(run_dir, step=5)
    kept = (run_dir / "config.json").read_text()
    try:
        write_config(run_dir, {**json.loads(kept), "sapo": {"horizon": 3, "patience": 2}})
        with pytest.raises(
            ValueError, match="this version has no option patience: use the version that the run was made with"
        ):
            load_run(run_dir)
        write_config(run_dir, {"train": {}})
        with pytest.raises(ValueError, match="names no environment and agent to build: build them as for training"):
            load_run(run_dir)
    finally:
        (run_dir / "config.json").write_text(kept)
