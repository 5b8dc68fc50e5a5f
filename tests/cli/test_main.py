"""Commands by name: help, wrong commands, and an environment of one's own from training to evaluation."""

import errno
import os
import runpy
import signal
import subprocess
import sys
import warnings

import pytest
import toys

from rewax.cli.main import main
from rewax.envs import registry

TASK = """
import toys
from rewax.envs import register

register("Mine", lambda scale: toys.point_mass(4))
"""
TINY = [*toys.TINY, "--train.no-plots"]


def rewax(folder, *argv):
    """The command in a process of its own, run from a folder."""
    return subprocess.run(
        [sys.executable, "-m", "rewax", *argv],
        cwd=folder,
        env=toys.subprocess_environment(),
        capture_output=True,
        text=True,
    )


def test_without_a_command_the_help_names_all(capsys):
    assert main([]) == 2
    text = capsys.readouterr().out
    assert all(f"rewax {name}" in text for name in ("train", "eval", "envs"))
    assert main(["--help"]) == 0 and capsys.readouterr().out == text


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["trian"], "there is no command 'trian': did you mean 'train'? use one of train, eval, bench, tune, play, plot, record, identify, export, landscape, envs, check, doctor, completion, or --help"),
        (["completion"], "rewax completion needs one word more: bash or zsh; rewax completion --help lists the options"),
        (["eval"], "rewax eval needs one run directory or task: rewax eval HandFlip"),
        (["eval", "--run-dir=a", "--episodes=0"], "episodes is 0: give an integer of at least 1"),
        (["eval", "--run-dir=a", "--episode=9"], "there is no option --episode: did you mean '--episodes'? rewax eval --help lists them"),
        (["eval", "--run-dir=."], ". holds no complete checkpoint: check the path"),
        (["landscape", "--run-dir=runs/typo"], "runs/typo holds no complete checkpoint: check the path"),
        (["envs", "--import=no.such.module"], "there is no module 'no.such.module' to import: check the name, or give the path of a .py file"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_one_sentence_and_exit_code_2(tmp_path, monkeypatch, capsys, argv, sentence):
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    assert capsys.readouterr() == ("", f"error: {sentence}\n")


def test_envs_prints_names_alone_where_a_program_reads_them(capsys):
    for argv in (["envs"], ["envs", "--names"]):
        assert main(argv) == 0
        assert capsys.readouterr().out.split() == registry.list_envs()


def test_envs_says_what_they_are_and_what_make_takes(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["envs", "--table"]) == 0
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert set(registry.list_envs()) <= set(rows)
    assert "flatten a piece of dough with a rolling pin." in rows["RollingFlat"]
    assert "youngs_modulus, yield_stress, dt" in rows["RollingFlat"] and "onset, stale_mass_matrix" in rows["AntRun"]


def test_envs_describes_those_that_are_named(capsys):
    assert main(["envs", "RollingFlat", "--scale=small"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("RollingFlat at scale small: flatten a piece of dough with a rolling pin.\n")
    for words in ("particle_q (64, 3)", "(3,), from -1 to 1", "60 control steps of 0.007 s", "youngs_modulus=750.0"):
        assert words in text
    assert main(["envs", "RolingFlat"]) == 2
    assert "did you mean 'RollingFlat'?" in capsys.readouterr().err


def test_a_reader_that_leaves_early_is_no_error(tmp_path):
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-m", "rewax", "envs"],
        cwd=tmp_path,
        env=toys.subprocess_environment(),
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")


def test_an_environment_of_ones_own_is_trained_and_evaluated(tmp_path):
    (tmp_path / "tasks.py").write_text(TASK)
    assert "Mine" in rewax(tmp_path, "envs", "--import=tasks").stdout.split()
    trained = rewax(tmp_path, "train", "--env=Mine", "--scale=small", "--import", "tasks.py", "--run-dir=a", *TINY)
    assert trained.returncode == 0, trained.stderr
    evaluated = rewax(tmp_path, "eval", "--run-dir=a", "--episodes=2", "--import=tasks")
    assert evaluated.returncode == 0, evaluated.stderr
    assert evaluated.stdout.startswith("sapo on Mine, iteration 1\n") and "0 of 2 failed" in evaluated.stdout
    evaluated = rewax(tmp_path, "eval", "--run-dir=a", "--episodes=2", "--no-video")
    assert evaluated.returncode == 0, evaluated.stderr
    (tmp_path / "tasks.py").unlink()
    unknown = rewax(tmp_path, "eval", "--run-dir=a", "--episodes=2")
    assert unknown.returncode == 2 and unknown.stderr.count("\n") == 1
    assert "--import of the module 'tasks' in" in unknown.stderr and "which is gone: put it back" in unknown.stderr


def test_the_examples_are_these_commands(monkeypatch, capsys):
    for example, words in (("train_sapo", ["train", "--sapo.num-envs"]), ("evaluate_policy", ["eval", "--run-dir"])):
        path = registry.__file__.replace("rewax/envs/registry.py", f"examples/{example}.py")
        monkeypatch.setattr(sys, "argv", [path, "--help"])
        with pytest.raises(SystemExit) as left:
            runpy.run_path(path, run_name="__main__")
        said = capsys.readouterr().out
        assert not left.value.code and f"rewax {words[0]}" in said and words[1] in said


def test_warnings_to_users_are_one_sentence(monkeypatch, capsys):
    def warns(argv):
        for kind in (UserWarning, DeprecationWarning):
            print(warnings.formatwarning("it is old: renew it", kind, "a.py", 3), end="")
        return 0

    monkeypatch.setattr("rewax.cli.main._run", warns)
    before = warnings.formatwarning
    assert main(["eval"]) == 0 and warnings.formatwarning is before
    assert capsys.readouterr().out == "warning: it is old: renew it\na.py:3: DeprecationWarning: it is old: renew it\n"


@pytest.mark.parametrize("code", [errno.EISDIR, errno.EROFS, errno.ENOENT, errno.EACCES])
def test_a_file_that_cannot_be_written_is_named(monkeypatch, capsys, code):
    def write(argv):
        raise OSError(code, os.strerror(code), ".writing-a.json", None, "a.json")

    monkeypatch.setattr("rewax.cli.main._run", write)
    assert main(["eval"]) == 2
    assert capsys.readouterr().err == f"error: a.json cannot be written or read ({os.strerror(code)}): choose another\n"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError("Unable to allocate 7 TiB\nfor an array"), "(Unable to allocate 7 TiB)"),
        (MemoryError(), "(out of memory)"),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes."), "(RESOURCE_EXHAUSTED: Out of memory "),
    ],
)
def test_too_little_memory_is_one_sentence(monkeypatch, capsys, error, said):
    def exhausts(argv):
        raise error

    monkeypatch.setattr("rewax.cli.main._run", exhausts)
    assert main(["eval"]) == 1
    message = capsys.readouterr().err
    assert message.startswith(f"error: the memory is too small {said}") and message.count("\n") == 1
    assert "take fewer environments" in message
    monkeypatch.setattr("rewax.cli.main._run", lambda argv: [].pop())
    with pytest.raises(IndexError):
        main(["eval"])


def test_a_factory_that_cannot_be_imported_spoils_no_table(tmp_path, monkeypatch, capsys):
    (tmp_path / "typo_of_mine.py").write_text("def f(:\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    broken = {"Absent": "nopkg.mod:f", "Typo": "typo_of_mine:f", "Fine": "toys:point_mass"}
    monkeypatch.setattr(registry, "_FACTORIES", broken)
    assert main(["envs", "--table"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "'nopkg.mod:f', which cannot be imported (No module named 'nopkg'): correct" in text
    assert "the import of its factory failed at" in text and "SyntaxError" in text and "A point mass with gain" in text
    for command in ("check", "train"):
        assert main([command, "--env=Absent"]) == 2
        assert "which cannot be imported" in capsys.readouterr().err
