"""The first and the last evaluation of a run, printed and returned."""

import pytest

from rewax.training import TrainConfig, train_and_compare
from rewax.training.loop import compare

HEADER = "iteration,env_steps,deterministic_mean\n"


@pytest.fixture
def run(monkeypatch, tmp_path):
    """``train_and_compare`` of a run that writes these rows of evaluations."""

    def run(*rows):
        def train(agent, env, config):
            assert (agent, env) == ("agent", "env")
            (tmp_path / "eval.csv").write_text(HEADER + "".join(rows))

        monkeypatch.setattr(compare, "train", train)
        return train_and_compare("agent", "env", TrainConfig(num_iterations=4, run_dir=str(tmp_path)))

    return run


def test_the_returns_are_those_of_the_first_and_the_last_evaluation(run, capsys):
    assert run("0,0,-3.25\n", "2,10,1.0\n", "4,20,7.5\n") == (-3.25, 7.5)
    assert capsys.readouterr().out.startswith("return per episode: -3.2 before, 7.5 after; see ")


def test_one_evaluation_is_not_enough(run):
    with pytest.raises(ValueError, match="has 1 evaluations: set eval_every to at most num_iterations"):
        run("4,20,7.5\n")
