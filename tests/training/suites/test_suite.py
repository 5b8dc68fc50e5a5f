"""Suites from TOML files, and what is wrong with them in a sentence."""

import pytest

from rewax.agents.registry import algorithm
from rewax.training.suites.runs import cells
from rewax.training.suites.suite import BUILT_IN, read_suite

TASK = 'scale = "small"\ntasks = ["Hopper"]\nalgorithms = ["sapo", "ppo"]\nseeds = [0, 3]\n'


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_suites_can_be_read_and_configured(name):
    suite = read_suite(name)
    assert suite.name == name and len(list(cells(suite))) == len(suite.tasks) * len(suite.algorithms) * len(suite.seeds)
    for task, name_of_algorithm in {(cell.task, cell.algorithm) for cell in cells(suite)}:
        assert isinstance(suite.config(task, name_of_algorithm), algorithm(name_of_algorithm).config_type)


def test_options_change_the_presets(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TASK + "[options.all]\nnum_envs = 4\n[options.sapo]\nactor_widths = [8, 8]\n")
    suite = read_suite(path)
    sapo, ppo = (suite.config("Hopper", name) for name in suite.algorithms)
    assert sapo.num_envs == ppo.num_envs == 4 and sapo.actor_widths == (8, 8) != ppo.actor_widths
    assert [tuple(cell) for cell in cells(suite)][:2] == [("Hopper", "sapo", 0), ("Hopper", "ppo", 0)]
    part = suite.only(tasks=("Hopper",), algorithms=("ppo",), seeds=(3,))
    assert [tuple(cell) for cell in cells(part)] == [("Hopper", "ppo", 3)]


def test_options_of_an_environment(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TASK.replace("Hopper", "AntRun") + "[env_options.AntRun]\nstale_mass_matrix = true\n")
    suite = read_suite(path)
    assert suite.env("AntRun").stale_mass_matrix and not read_suite("paper").env("AntRun").stale_mass_matrix
    assert suite.only(tasks=("AntRun",), algorithms=("ppo",), seeds=(3,)).env("AntRun").stale_mass_matrix


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (TASK + "speed = 3\n", "has the unknown entry 'speed': known are"),
        (TASK.replace("seeds = [0, 3]\n", ""), "has no entry 'seeds': add it"),
        (TASK.replace("Hopper", "Hoper"), "there is no environment named 'Hoper': did you mean 'Hopper'?"),
        (TASK.replace("ppo", "pppo"), "there is no algorithm named 'pppo': did you mean 'ppo'?"),
        (TASK.replace("[0, 3]", "[0, -3]"), "give integers from 0 to 4294967295"),
        (TASK.replace("[0, 3]", "[0, 4294967296]"), "give integers from 0 to 4294967295"),
        (TASK.replace("[0, 3]", "[[0]]"), "give integers from 0 to 4294967295"),
        (
            TASK.replace('["Hopper"]', '[["Hopper"]]'),
            "tasks of the suite mine have the entry ['Hopper']: give names in",
        ),
        (TASK.replace('"ppo"', "3"), "algorithms of the suite mine have the entry 3: give names in quotes"),
        (TASK.replace("[0, 3]", "[0, 0]"), "seeds of the suite mine are [0, 0]: name each of them once"),
        (TASK.replace("[0, 3]", "3"), "seeds of the suite mine is 3: give a list with at least one entry"),
        (TASK + "steps = 5\n", "steps of the suite mine is no table"),
        (TASK + 'num_eval_episodes = "64"\n', "is '64': give an integer of at least 1"),
        (TASK + "[options.all]\nnum_env = 4\n", "no algorithm of the suite mine has the option 'num_env'"),
        (TASK.replace('["Hopper"]', "[]"), "give a list with at least one entry"),
        (TASK + "[steps]\nAnt = 3\n", "steps of the suite mine name 'Ant', which is not one of its tasks"),
        (
            TASK + "[env_options.Ant]\nonset = 0.1\n",
            "env_options of the suite mine name 'Ant', which is not one of its tasks",
        ),
        (TASK + "[env_options]\nHopper = 3\n", "is no table: write [env_options.Hopper]"),
        (
            TASK + '[env_options.Hopper]\nscale = "paper"\n',
            "env_options.Hopper of the suite mine gives scale: write it",
        ),
        (
            TASK + "[steps]\nHopper = 99\n[options.all]\nnum_iterations = 3\n",
            "steps and num_iterations of options.all of the suite mine both say how long to train: give one of them",
        ),
        (TASK + "[options.sac]\nnum_envs = 3\n", "name 'sac', which is not one of its algorithms"),
        ("scale = ", "is not TOML"),
        (b"scale = \xff", "is not TOML"),
    ],
)
def test_a_suite_that_cannot_be_is_one_sentence(tmp_path, text, sentence):
    path = tmp_path / "mine.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError) as caught:
        read_suite(path)
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


def test_an_option_that_no_algorithm_has(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TASK + "[options.ppo]\nnum_env = 4\n")
    with pytest.raises(ValueError, match="ppo has no option num_env: correct the suite mine"):
        read_suite(path).config("Hopper", "ppo")
    known = ", ".join(BUILT_IN)
    with pytest.raises(ValueError, match=f"there is no suite 'nowhere': use {known}, or the path"):
        read_suite("nowhere")


def test_a_part_keeps_the_shared_options_that_its_algorithms_have(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TASK.replace("ppo", "sac") + "[options.all]\nreplay_size = 1600\nnum_envs = 4\n")
    suite = read_suite(path)
    part = suite.only(tasks=("Hopper",), algorithms=("sapo",), seeds=(0,))
    assert part.options["all"] == {"num_envs": 4} and suite.config("Hopper", "sac").replay_size == 1600
