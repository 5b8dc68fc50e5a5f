"""A new run begins with what an old one has learnt, and with nothing else of it."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
import toys

from rewax.agents.ahac import AHACConfig, make_ahac
from rewax.agents.ivw import IVWConfig, make_ivw
from rewax.agents.ppo import make_ppo
from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.cli.main import main
from rewax.envs import registry
from rewax.training.loop.warm_start import warm_started
from rewax.training.storage import checkpoint

SIZES = ("num_envs", "critic_passes", "critic_minibatches", "vector_features", "actor_widths", "critic_widths")
OPTIONS = [*(option for option in toys.TINY if "num-iterations" not in option), "--train.no-plots"]


@pytest.fixture(scope="module")
def toy():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._FACTORIES, "ToyForWarmStart", lambda scale: toys.point_mass(4))
        yield "ToyForWarmStart"


@pytest.fixture(scope="module")
def old(toy, tmp_path_factory):
    """The directory of a run of two iterations."""
    folder = tmp_path_factory.mktemp("runs") / "old"
    assert main(["train", f"--env={toy}", "--scale=small", f"--run-dir={folder}", "--steps=8", *OPTIONS]) == 0
    return folder


def tiny(**changes):
    """The options above, as a configuration."""
    sizes = {"num_envs": 2, "horizon": 2, "critic_passes": 1, "critic_minibatches": 1, "vector_features": 4}
    return SAPOConfig(**{**sizes, "actor_widths": (4, 4), "critic_widths": (4,), **changes})


def equal(a, b):
    """Whether two trees hold the same numbers."""
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_what_was_learnt_is_taken_over_and_all_else_begins_anew(old):
    agent = make_sapo(toys.point_mass(4), tiny())
    fresh = agent.init(jax.random.key(7))
    then = checkpoint.restore(old, jax.eval_shape(agent.init, jax.random.key(0)))
    warm = warm_started(fresh, old)
    for name in ("actor_params", "critic_params", "log_temperature"):
        assert equal(getattr(warm, name), getattr(then, name)), name
        assert not equal(getattr(warm, name), getattr(fresh, name)), name
    assert equal(warm.environments.statistics, then.environments.statistics)
    assert float(warm.environments.statistics.count) > 1.0
    assert int(then.iteration) == 2 and int(warm.iteration) == int(warm.env_steps) == 0
    assert equal(warm.actor_opt, fresh.actor_opt) and not equal(fresh.actor_opt, then.actor_opt)
    assert equal(jax.random.key_data(warm.key), jax.random.key_data(fresh.key))
    assert equal(warm.environments.state.obs, fresh.environments.state.obs)


def test_the_command_begins_with_the_old_run_and_goes_on_from_there(old, toy, tmp_path, capsys):
    argv = [
        "train",
        f"--env={toy}",
        "--scale=small",
        f"--run-dir={tmp_path / 'new'}",
        "--steps=8",
        "--seed=3",
        *OPTIONS,
    ]
    assert main([*argv, f"--init-from={old}"]) == 0
    assert f"beginning with what {old} has learnt" in capsys.readouterr().out
    assert checkpoint.latest_step(tmp_path / "new") == 2
    origin = lambda: json.loads((tmp_path / "new" / "config.json").read_text())["train"]["init_from"]  # noqa: E731
    assert origin() == str(old)
    assert main([*argv, "--resume"]) == 0 and origin() == str(old)
    assert main([*argv, "--resume", f"--init-from={old}"]) == 0 and origin() == str(old)
    assert main([*argv, "--resume", "--init-from=other"]) == 2 and origin() == str(old)
    assert (
        f"holds a run that began with what {old} has learnt: resume it without --init-from" in capsys.readouterr().err
    )


def test_neither_algorithm_nor_environment_has_to_be_registered(old, tmp_path):
    """A run of an algorithm that only the calling code knows is read by the names of its arrays."""
    run_dir = shutil.copytree(old, tmp_path / "run")
    config = json.loads((run_dir / "config.json").read_text())
    (run_dir / "config.json").write_text(json.dumps({**config, "agent": "mine", "mine": config["sapo"], "env": "gone"}))
    agent = make_sapo(toys.point_mass(4), tiny())
    then = checkpoint.restore(old, jax.eval_shape(agent.init, jax.random.key(0)))
    warm = warm_started(agent.init(jax.random.key(7)), run_dir, "mine")
    assert equal(warm.actor_params, then.actor_params)


def test_another_horizon_than_that_of_the_old_run(tmp_path):
    env, sizes = toys.point_mass(4), dataclasses.asdict(tiny())
    short, long = (make_ivw(env, IVWConfig(**{**sizes, "horizon": horizon})) for horizon in (2, 3))
    then, fresh = short.init(jax.random.key(0)), long.init(jax.random.key(7))
    checkpoint.save(tmp_path, then, keep=1)
    (tmp_path / "config.json").write_text(json.dumps({"agent": "sapo_ivw"}))
    warm = warm_started(fresh, tmp_path, "sapo_ivw")
    assert equal(warm.actor_params, then.actor_params) and warm.variance.shape == (3,)


def test_an_adaptive_horizon_begins_anew(tmp_path):
    sizes = {name: value for name, value in dataclasses.asdict(tiny()).items() if name in SIZES}
    options = {"min_horizon": 2, "initial_horizon": 4, "horizon": 8}
    agent = make_ahac(toys.point_mass(4), AHACConfig(**{**sizes, **options}))
    then = agent.init(jax.random.key(0))
    checkpoint.save(tmp_path, then.replace(horizon=then.horizon - 2.0), keep=1)
    (tmp_path / "config.json").write_text(json.dumps({"agent": "ahac"}))
    warm = warm_started(agent.init(jax.random.key(7)), tmp_path, "ahac")
    assert equal(warm.actor_params, then.actor_params) and float(warm.horizon) == 4.0


def test_what_does_not_fit_is_one_sentence(old, tmp_path):
    env = toys.point_mass(4)
    wide = make_sapo(env, tiny(actor_widths=(5, 4))).init(jax.random.key(0))
    with pytest.raises(
        ValueError, match=r"actor_params of .* has other shapes than this run's: give the networks' options"
    ):
        warm_started(wide, old)
    with pytest.raises(
        ValueError,
        match=r"was trained with sapo: it has learnt log_temperature, which ppo does not have: begin with a run of the same algorithm",
    ):
        warm_started(make_ppo(env).init(jax.random.key(0)), old, "ppo")
    with pytest.raises(ValueError, match="nowhere holds no complete checkpoint: check the path"):
        warm_started(wide, tmp_path / "nowhere")
