"""Several seeds in one program: each is its solo run, and one that fails does not stop the others."""

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from rich.console import Console

from rewax.training.config import TrainConfig
from rewax.training.loop.run import Run
from rewax.training.loop.seeds import train_seeds
from rewax.training.loop.train import train
from rewax.training.storage import checkpoint
from rewax.training.storage.metrics import read_csv

ENV = toys.point_mass()
AGENT = toys.make_toy(ENV)
QUIET = {"eval_every": 0, "baselines": False, "plots": False, "tensorboard": False, "num_eval_episodes": 2}


def configs(folder, seeds, **changes):
    options = {"num_iterations": 6, "checkpoint_every": 3, **QUIET, **changes}
    return [TrainConfig(**options, seed=seed, run_dir=str(folder / str(seed))) for seed in seeds]


def console():
    return Console(file=io.StringIO(), width=200)


def test_each_seed_is_its_solo_run(tmp_path):
    together = train_seeds(AGENT, ENV, configs(tmp_path / "a", (0, 5)), console=console())
    for result, config in zip(together, configs(tmp_path / "b", (0, 5)), strict=True):
        alone = train(AGENT, ENV, config, console=console())
        np.testing.assert_allclose(result.train_state.bias, alone.train_state.bias, rtol=1e-5)
        assert result.evaluation["deterministic_mean"] == pytest.approx(
            alone.evaluation["deterministic_mean"], rel=1e-5
        )
        ours, theirs = (read_csv(tmp_path / name / str(config.seed) / "metrics.csv") for name in "ab")
        np.testing.assert_allclose(ours["reward"], theirs["reward"], rtol=1e-5)
    assert together[0].train_state.bias != together[1].train_state.bias


def test_they_are_resumed_together_or_alone(tmp_path):
    first = configs(tmp_path, (0, 1), num_iterations=3)
    train_seeds(AGENT, ENV, first, console=console())
    more = [dataclasses.replace(config, num_iterations=6, resume=True) for config in first]
    results = train_seeds(AGENT, ENV, more, console=console())
    assert [int(result.train_state.iteration) for result in results] == [6, 6]
    train(AGENT, ENV, dataclasses.replace(more[0], num_iterations=7), console=console())
    # One seed is further than the other, as after a failure of one of them.
    results = train_seeds(AGENT, ENV, [dataclasses.replace(c, num_iterations=9) for c in more], console=console())
    assert [int(result.train_state.iteration) for result in results] == [9, 9]
    for seed, result in enumerate(results):
        alone = train(AGENT, ENV, configs(tmp_path / "alone", (seed,), num_iterations=9)[0], console=console())
        np.testing.assert_allclose(result.train_state.bias, alone.train_state.bias, rtol=1e-5)
        assert checkpoint.latest_step(tmp_path / str(seed)) == 9
        done = read_csv(tmp_path / str(seed) / "metrics.csv")["iteration"]
        np.testing.assert_array_equal(done, np.arange(1, 10))


def test_a_seed_that_fails_ends_alone(tmp_path):
    @jax.jit
    def train_step(state):
        state, metrics = AGENT.train_step(state)
        return state.replace(bias=jnp.where((state.iteration == 4) & (state.bias < -1e9), jnp.nan, state.bias)), metrics

    def poisoned(seed):
        def init(key):
            state = AGENT.init(key)
            return state.replace(bias=jnp.where(jax.random.key_data(key)[1] == seed, -2e9, state.bias))

        return AGENT._replace(init=init, train_step=train_step)

    broken, whole = train_seeds(poisoned(0), ENV, configs(tmp_path, (0, 1)), console=console())
    assert "made .bias of the training state infinite or NaN" in broken.failure
    assert whole.failure == "" and int(whole.train_state.iteration) == 6
    assert checkpoint.steps(tmp_path / "0") == [0, 3] and checkpoint.steps(tmp_path / "1")[-1] == 6


def test_all_seeds_are_saved_though_one_cannot_be(tmp_path, monkeypatch):
    end, ended = Run.end, []

    def failing(run):
        ended.append(run.run_dir.name)
        if run.run_dir.name == "0":
            raise OSError("the disk of seed 0 is gone")
        end(run)

    monkeypatch.setattr(Run, "end", failing)
    with pytest.raises(OSError, match="seed 0 is gone"):
        train_seeds(AGENT, ENV, configs(tmp_path, (0, 1), checkpoint_every=0), console=console())
    assert sorted(ended) == ["0", "1"] and checkpoint.latest_step(tmp_path / "1") == 6
