"""The first and the last evaluation of a run, printed and returned."""

import pytest

from rewax.training import TrainConfig, train_and_compare
from rewax.training.loop import compare
from rewax.training.loop.run import TrainResult

HEADER = "iteration,env_steps,deterministic_mean\n"


@pytest.fixture
def run(monkeypatch, tmp_path):
    """``train_and_compare`` of a run that writes these rows of evaluations, and returns a result with these fields."""

    def run(*rows, **result):
        def train(agent, env, config):
            assert (agent, env) == ("agent", "env")
            (tmp_path / "eval.csv").write_text(HEADER + "".join(rows))
            return TrainResult(None, {}, **result)

        monkeypatch.setattr(compare, "train", train)
        return train_and_compare("agent", "env", TrainConfig(num_iterations=4, run_dir=str(tmp_path)))

    return run


def test_the_returns_are_those_of_the_first_and_the_last_evaluation(run, capsys, tmp_path):
    for picture in ("", "/episode.png"):
        assert run("0,0,-3.25\n", "2,10,1.0\n", "4,20,7.5\n") == (-3.25, 7.5)
        assert capsys.readouterr().out == f"return per episode: -3.2 before, 7.5 after; see {tmp_path}{picture}\n"
        (tmp_path / "episode.png").touch()


@pytest.mark.parametrize(
    ("result", "why"),
    [
        ({}, "give a positive eval_every, below num_iterations if eval_at_start is False"),
        ({"failure": "critic_loss was not finite"}, "critic_loss was not finite"),
        ({"signum": 2}, "the run was stopped early, and resume=True continues it"),
    ],
)
def test_one_evaluation_is_not_enough(run, result, why):
    with pytest.raises(ValueError, match=f"has fewer than two evaluations: {why}$"):
        run("4,20,7.5\n", **result)
