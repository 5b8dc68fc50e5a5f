"""Arguments and users' modules: what is found, and what is refused."""

import contextlib
import dataclasses
import io
import sys
from typing import Literal

import pytest

from rewax.cli.options import Imports, import_modules, parse


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inner:
    num_envs: int = 3
    limit: float | None = None
    kind: Literal["a", "b"] = "a"
    flag: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outer:
    inner: Inner = dataclasses.field(default_factory=Inner)
    imports: Imports = ()


def read(*argv):
    return parse(Outer, argv, prog="tool", description="A tool.")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory whose modules are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_options_are_read():
    assert read("--inner.num-envs", "5", "--import=a", "--import", "b.py") == Outer(
        inner=Inner(num_envs=5), imports=("a", "b.py")
    )


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["--inner.num-env=5"], "there is no option --inner.num-env: did you mean '--inner.num-envs'? tool --help lists them"),
        (["--imports=a"], "there is no option --imports: did you mean '--import'? tool --help lists them"),
        (["stray"], "tool takes no argument 'stray': tool --help lists the options"),
        (["RollingFlat"], "tool takes no argument 'RollingFlat': did you mean --env RollingFlat? tool --help lists the options"),
        (["--inner.num-envs=many"], "--inner.num-envs is 'many': give an integer; tool --help lists the options"),
        (["--inner.limit=abc"], "--inner.limit is 'abc': give a number, or None; tool --help lists the options"),
        (["--inner.limit"], "--inner.limit lacks a value: give 1 after it; tool --help lists the options"),
        (["--inner.kind=c"], "--inner.kind is 'c': use a or b; tool --help lists the options"),
        (["--inner.flag=3"], "--inner.flag takes no value, but '3' was given: write --inner.flag, or --inner.no-flag for the opposite"),
    ],
)  # fmt: skip
def test_an_option_that_cannot_be_is_one_sentence(argv, sentence, capfd):
    for encoding in ("utf-8", "ascii"):  # the parser draws another box for each
        with contextlib.ExitStack() as stack:
            stack.enter_context(contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), encoding=encoding)))
            caught = stack.enter_context(pytest.raises(ValueError))
            read(*argv)
        assert str(caught.value) == sentence
    assert capfd.readouterr() == ("", "")


def test_modules_are_found_by_name_and_by_path_and_run_once(folder):
    (folder / "by_name.py").write_text("import beside\nbeside.RUNS.append('by_name')\n")
    (folder / "beside.py").write_text("RUNS = []\n")
    (folder / "sub").mkdir()
    (folder / "sub" / "by_path.py").write_text("import by_path_sibling, beside\nbeside.RUNS.append('by_path')\n")
    (folder / "sub" / "by_path_sibling.py").write_text("")
    import_modules(["by_name", "sub/by_path.py", "sub/by_path.py", "by_name"])
    assert sys.modules["beside"].RUNS == ["by_name", "by_path"]


def test_a_file_with_the_name_of_another_module_is_refused(folder):
    for name in ("json.py", "two.dots.py"):
        (folder / name).write_text("raise AssertionError('this ran')\n")
        with pytest.raises(ValueError, match=r"cannot be imported as .* a name that is taken: rename the file"):
            import_modules([name])


def test_an_exception_inside_a_module_is_a_sentence_with_its_line(folder):
    (folder / "broken.py").write_text("import package_that_is_missing\n")
    (folder / "wrong.py").write_text("import rewax\nrewax.register('A', 'nothing')\n")
    (folder / "unreadable.py").write_text("def f(:\n")
    (folder / "leaves.py").write_text("import sys\nsys.exit(3)\n")
    for name, words in {
        "broken": r"broken failed at .*broken\.py:1 \(import package_that_is_missing\): ModuleNotFoundError: No module",
        "broken.py": r"broken\.py:1 ",
        "wrong.py": r"wrong\.py:2 \(rewax\.register\('A', 'nothing'\)\): ValueError: the factory of 'A'",
        "unreadable": r"unreadable\.py:1: SyntaxError: ",
        "leaves": r"leaves\.py:2 \(sys\.exit\(3\)\): SystemExit: 3",
    }.items():
        with pytest.raises(ValueError, match=words):
            import_modules([name])
    for name in ("absent.part", "..", "a..b"):
        with pytest.raises(ValueError, match=f"there is no module '{name}'"):
            import_modules([name])
