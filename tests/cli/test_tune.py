"""``rewax tune`` says what it lacks."""

import importlib.util

from rewax.cli.main import main


def test_without_optuna_it_says_what_to_install(monkeypatch, capsys):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "optuna" else real(name, *rest)
    )
    assert main(["tune", "--env", "Hopper", "--algo", "ppo"]) == 2
    assert capsys.readouterr().err == "error: rewax tune needs optuna: pip install 'rewax[tune]'\n"


def test_what_cannot_be_is_one_sentence(capsys):
    assert main(["tune", "--trials", "0"]) == 2
    assert capsys.readouterr().err == "error: trials is 0: give an integer of at least 1\n"
    assert main(["tune", "--seeds", "3", "3"]) == 2
    assert capsys.readouterr().err == "error: seeds are [3, 3]: give integers from 0 to 4294967295, each of them once\n"
