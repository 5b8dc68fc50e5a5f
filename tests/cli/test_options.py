"""Arguments and users' modules: what is found, and what is refused."""

import contextlib
import dataclasses
import io
import sys

import pytest

from rewax.cli.options import Imports, import_modules, parse


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inner:
    num_envs: int = 3


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
        (["stray"], "there is no option stray: tool --help lists them"),
        (["--inner.num-envs=many"], "Error parsing --inner.num-envs: invalid literal for int() with base 10: 'many'; tool --help lists the options"),
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


def test_errors_inside_a_module_are_its_own(folder):
    (folder / "broken.py").write_text("import package_that_is_missing\n")
    for name in ("broken", "broken.py"):
        with pytest.raises(ModuleNotFoundError, match="package_that_is_missing"):
            import_modules([name])
    with pytest.raises(ValueError, match=r"there is no module 'broken\.part'|there is no module 'absent\.part'"):
        import_modules(["absent.part"])
