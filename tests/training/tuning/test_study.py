"""A search: it finds the best, counts failures as bad, is continued and shared."""

import csv
import dataclasses
import io
import json
import os
import signal
import tomllib
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from rich.console import Console

pytest.importorskip("optuna", reason="pip install 'rewax[tune]'")

from rewax.agents import registry as agents
from rewax.agents.config import steps_in
from rewax.agents.registry import Algorithm
from rewax.training.evaluation.episodes import make_evaluate
from rewax.training.tuning import study as studies
from rewax.training.tuning import trial as trials
from rewax.training.tuning.report import as_command, as_toml, best_trial
from rewax.training.tuning.space import Range
from rewax.training.tuning.study import open_study, run_study
from rewax.training.tuning.trial import Failed, Report, Task, run_trial

SPACE = {"noise": Range(0.01, 1.0, True), "horizon": Range(choices=(3, 6))}
TASK = Task(env="PointMass", scale="small", algo="calm", seeds=(1000, 1001), episodes=8, reports=2)


@pytest.fixture(autouse=True)
def calm(monkeypatch):
    config = dataclasses.make_dataclass(
        "ToyConfig",
        [("num_envs", int, 4), ("horizon", int, 3), ("num_iterations", int, 8), ("noise", float, 0.1)],
        frozen=True,
        namespace={"steps_in": lambda self, env: self.horizon},
    )
    make = lambda env, config: toys.make_toy(env, num_envs=4, horizon=config.horizon, noise=config.noise)  # noqa: E731
    known = Algorithm(make, config, lambda env_name, scale: config())
    monkeypatch.setitem(agents._ALGORITHMS, "calm", lambda: known)


def search(folder, num_trials, task=TASK):
    console = Console(file=io.StringIO(), width=200)
    signum = run_study(task, SPACE, toys.point_mass(), folder, num_trials, console)
    return signum, console.file.getvalue()


def table(folder):
    with (folder / "trials.csv").open() as file:
        return list(csv.DictReader(file))


def quickly(mean=lambda values: -values["noise"]):
    """A ``run_trial`` that trains nothing."""

    def run_trial(task, env, values, console, stopped):
        for number in range(1, task.reports + 1):
            yield Report(number, mean(values))

    return run_trial


def test_a_trial_trains_its_seeds_as_long_as_the_preset():
    quiet, long = Console(file=io.StringIO()), {"noise": 0.1, "horizon": 6}
    assert TASK.config(toys.point_mass(), long).num_iterations == 4  # 8 iterations of 3 steps
    assert dataclasses.replace(TASK, steps=240).config(toys.point_mass(), long).num_iterations == 10
    plain = dataclasses.make_dataclass("Plain", [("num_envs", int, 4), ("horizon", int, 3), ("num_iterations", int, 8)])
    assert steps_in(plain(), toys.point_mass()) == 3  # a configuration that is no RunConfig
    with pytest.raises(ValueError, match=r"^object has no horizon: derive it from rewax.agents.config.RunConfig"):
        steps_in(object(), toys.point_mass())
    reports = list(run_trial(TASK, toys.point_mass(), {"noise": 0.1}, quiet, lambda: False))
    agent, means = toys.make_toy(toys.point_mass()), []
    for seed in TASK.seeds:
        state = agent.init(jax.random.key(seed))
        for _ in range(8):
            state, _ = agent.train_step(state)
        key = jax.random.fold_in(jax.random.key(seed), trials._EVALUATION_STREAM)
        means.append(make_evaluate(toys.point_mass(), agent.policy, 8)(state, key)["mean"])
    assert [report.number for report in reports] == [1, 2]
    np.testing.assert_allclose(reports[1].mean, np.mean(means), rtol=1e-5)
    assert reports[0].mean < reports[1].mean


def test_options_that_cannot_be_make_a_bad_trial():
    from rewax.agents.registry import algorithm

    task = dataclasses.replace(TASK, env="Hopper", algo="ppo")
    assert algorithm("ppo").preset("Hopper", "small").samples % 3
    with pytest.raises(Failed, match="minibatches is 3, which does not divide"):
        next(run_trial(task, toys.point_mass(), {"minibatches": 3}, Console(file=io.StringIO()), lambda: False))


def test_failing_episodes_make_a_bad_trial_however_short_it_is(monkeypatch):
    quiet = Console(file=io.StringIO())
    seed = trials._Seed(toys.point_mass(), toys.make_toy(toys.point_mass()), 0)
    seed.check_failures(2, 8)
    with pytest.raises(Failed, match="7 of 8 evaluated episodes failed numerically"):
        seed.check_failures(7, 8)
    monkeypatch.setattr(trials.FailureWatch, "reason", lambda self, final=False: "too many" if final else "")
    with pytest.raises(Failed, match="too many"):
        next(run_trial(TASK, toys.point_mass(), {"noise": 0.1}, quiet, lambda: False))


def test_numbers_that_are_not_finite_make_a_bad_trial(tmp_path):
    broken = toys.PointMass(gain=jnp.float32(jnp.inf))
    with pytest.raises(Failed, match="infinite or NaN"):
        list(run_trial(TASK, broken, {"noise": 0.1}, Console(file=io.StringIO()), lambda: False))
    assert run_study(TASK, SPACE, broken, tmp_path, 2, Console(file=io.StringIO())) == 0
    assert [row["state"] for row in table(tmp_path)] == ["failed", "failed"]
    assert best_trial(open_study(tmp_path), SPACE) is None


def test_it_begins_with_the_preset_and_finds_better(tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "run_trial", quickly())
    assert search(tmp_path, 12)[0] == 0
    rows = table(tmp_path)
    assert len(rows) == 12 and (rows[0]["noise"], rows[0]["horizon"], rows[0]["mean"]) == ("0.1", "3", "-0.1")
    best = best_trial(open_study(tmp_path), SPACE)
    finished = [float(row["mean"]) for row in rows if row["state"] == "complete"]
    assert best.mean == max(finished) > -0.1 and best.values["horizon"] in (3, 6)


def test_what_fails_is_bad_and_never_the_best(tmp_path, monkeypatch):
    def mean(values):
        if values["noise"] > 0.05:
            raise Failed("it fell over") if values["horizon"] == 3 else ValueError("no program")
        return -values["noise"]

    monkeypatch.setattr(studies, "run_trial", quickly(mean))
    assert search(tmp_path, 15)[0] == 0
    rows = table(tmp_path)
    failed = [row for row in rows if row["state"] == "failed"]
    assert rows[0]["failure"] == "it fell over" and len(rows) == 15 > len(failed)
    assert {row["failure"] for row in failed} == {"it fell over", "ValueError: no program"}
    assert best_trial(open_study(tmp_path), SPACE).values["noise"] <= 0.05


def test_a_search_is_continued_and_a_trial_that_was_cut_off_done_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "run_trial", quickly())
    assert search(tmp_path, 2)[0] == 0
    cut_off = open_study(tmp_path).ask({name: _distribution(where) for name, where in SPACE.items()})
    assert search(tmp_path, 4)[0] == 0
    rows = table(tmp_path)
    assert [row["state"] for row in rows] == ["complete", "complete", "fail", "complete", "complete"]
    assert rows[3]["noise"] == rows[2]["noise"] == str(cut_off.params["noise"])
    assert search(tmp_path, 4)[0] == 0 and len(table(tmp_path)) == 5  # nothing is left


def test_a_preset_that_cannot_be_trained_ends_the_search_in_one_sentence(tmp_path, monkeypatch):
    def broken(values):
        raise ValueError("env.step returned a list")

    with monkeypatch.context() as patch, pytest.raises(ValueError, match="returned a list"):
        patch.setattr(studies, "run_trial", quickly(broken))
        search(tmp_path, 3)
    monkeypatch.setattr(studies, "run_trial", quickly())
    assert search(tmp_path, 3)[0] == 0
    assert [row["state"] for row in table(tmp_path)] == ["failed", "complete", "complete"]


def test_a_trial_that_is_stopped_in_its_last_evaluation_is_complete(tmp_path, monkeypatch):
    def run_trial(task, env, values, console, stopped):
        for number in range(1, task.reports + 1):
            if number == cut:
                os.kill(os.getpid(), signal.SIGINT)
            yield Report(number, 1.0)

    monkeypatch.setattr(studies, "run_trial", run_trial)
    cut = TASK.reports
    assert search(tmp_path, 3)[0] == signal.SIGINT
    assert [row["state"] for row in table(tmp_path)] == ["complete"]


def test_the_preset_is_tried_again_if_it_was_cut_off_before_it_began(tmp_path, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(studies, "run_trial", quickly())
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(studies, "_do", interrupted)
        search(tmp_path, 1)
    search(tmp_path, 1)
    assert best_trial(open_study(tmp_path), SPACE).values == {"noise": 0.1, "horizon": 3}


def _distribution(where):
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    choices = CategoricalDistribution(list(range(len(where.choices)))) if where.choices else None
    return choices or FloatDistribution(where.low, where.high, log=where.log)


def test_another_search_does_not_belong_into_the_directory(tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "run_trial", quickly())
    search(tmp_path, 1)
    with pytest.raises(ValueError, match="holds a search with other seeds: choose another directory"):
        search(tmp_path, 1, dataclasses.replace(TASK, seeds=(7,)))
    stored = json.loads((tmp_path / "study.json").read_text())
    (tmp_path / "study.json").write_text(json.dumps({**stored, "task": {**stored["task"], "gravity": 1}}))
    with pytest.raises(ValueError, match="holds a search with other gravity: choose another directory"):
        search(tmp_path, 1)
    (tmp_path / "study.json").write_text("[1]")
    with pytest.raises(ValueError, match=r"study\.json cannot be read .*: choose another directory"):
        search(tmp_path, 1)


def test_processes_share_a_study(tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "run_trial", quickly())
    with ThreadPoolExecutor(3) as pool:  # the locks are of open files: threads are as good as processes
        assert [signum for signum, _ in pool.map(lambda _: search(tmp_path, 6), range(3))] == [0, 0, 0]
    rows = table(tmp_path)
    assert len(rows) == 6 and all(row["state"] in ("complete", "pruned") for row in rows)


def test_the_best_is_printed_as_a_command_and_as_a_table_of_a_suite():
    task = dataclasses.replace(TASK, env="Hopper", algo="sac", steps=1024)
    values = {"batch_size": 512, "normalize_rewards": False, "actor_widths": (64, 32)}
    assert as_command(task, values, 1024) == (
        "rewax train --env Hopper --scale small --algo sac --sac.batch-size 512 --sac.no-normalize-rewards "
        "--sac.actor-widths 64 32 --steps 1024"
    )
    own = as_command(task, {}, 1024, ("my tasks.py", "more"))
    assert own.startswith("rewax train --env Hopper --scale small --algo sac --import 'my tasks.py' --import more")
    assert tomllib.loads(as_toml(task, values, 1024)) == {
        "options": {"sac": {"batch_size": 512, "normalize_rewards": False, "actor_widths": [64, 32]}},
        "steps": {"Hopper": 1024},
    }
