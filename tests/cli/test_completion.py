"""The completion scripts, run by the shells themselves."""

import dataclasses
import shutil
import subprocess

import pytest

from rewax.agents.registry import algorithm, list_algorithms
from rewax.cli.main import COMMANDS, main
from rewax.envs.registry import list_envs
from rewax.training.config import ReportConfig


@pytest.fixture(scope="module")
def script():
    """The script for bash."""
    import contextlib
    import io

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["completion", "bash"]) == 0
    return said.getvalue()


def completed(script, *words, cwd=None):
    """What bash offers for the last of some words."""
    typed = " ".join(f"'{word}'" for word in words)
    ask = f'COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}; _rewax; printf "%s\\n" "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "-c", f"{script}\n{ask}"], capture_output=True, text=True, cwd=cwd, check=True)
    assert not done.stderr
    return [line for line in done.stdout.splitlines() if line]


def test_commands_environments_and_algorithms_are_completed(script):
    assert completed(script, "rewax", "") == list(COMMANDS)
    assert completed(script, "rewax", "pl") == ["play", "plot"]
    assert completed(script, "rewax", "train", "--env", "Rolling") == ["RollingFlat"]
    assert completed(script, "rewax", "train", "--env", "=", "Rolling") == ["RollingFlat"]
    assert completed(script, "rewax", "train", "--env", "=") == list_envs()
    assert completed(script, "rewax", "train", "--seed", "1", "--algo", "") == list_algorithms()
    assert completed(script, "rewax", "eval", "--scale", "p") == ["paper"]


def test_every_option_of_every_command_is_completed(script):
    assert completed(script, "rewax", "eval", "--ep") == ["--episodes"]
    trained = completed(script, "rewax", "train", "--")
    named = {f"--train.{field.name.replace('_', '-')}" for field in dataclasses.fields(ReportConfig)}
    assert named <= set(trained) and {"--train.no-plots", "--resume", "--devices", "--import"} <= set(trained)
    for name in list_algorithms():
        options = {field.name.replace("_", "-") for field in dataclasses.fields(algorithm(name).config_type)}
        assert {f"--{name.replace('_', '-')}.{option}" for option in options} <= set(trained), name


def test_files_are_completed_elsewhere(script, tmp_path):
    (tmp_path / "runs").mkdir()
    assert completed(script, "rewax", "play", "ru", cwd=tmp_path) == ["runs"]
    assert completed(script, "rewax", "eval", "--run-dir", "ru", cwd=tmp_path) == ["runs"]


def test_names_of_files_may_have_spaces_and_stars(script, tmp_path):
    names = ["my *", "my run", "my run 2"]
    for name in names:
        (tmp_path / name).mkdir()
    assert sorted(completed(script, "rewax", "play", "my", cwd=tmp_path)) == names
    assert sorted(completed(script, "rewax", "play", "my r", cwd=tmp_path)) == names[1:]


def test_a_shell_without_a_script_is_a_sentence(capsys):
    assert main(["completion", "fish"]) == 2
    assert capsys.readouterr().err == "error: there is no completion for 'fish': use one of bash, zsh\n"


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_reads_its_script(capsys):
    assert main(["completion", "zsh"]) == 0
    script = capsys.readouterr().out
    done = subprocess.run(
        ["zsh", "-fc", f"autoload -U compinit; compinit -u\n{script}"], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
