"""From arguments to dataclasses, and users' own modules."""

import contextlib
import dataclasses
import importlib
import importlib.util
import io
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import tyro

from rewax.envs.registry import did_you_mean

T = TypeVar("T")
Imports: TypeAlias = tyro.conf.UseAppendAction[
    Annotated[tuple[str, ...], tyro.conf.arg(name="import", metavar="MODULE")]
]
"""Field of the options ``--import``, which may be repeated."""


def parse(options: type[T], argv: Sequence[str], *, prog: str, description: str) -> T:
    """Fill a dataclass from arguments.

    Args:
      options: dataclass with a default for every optional field.
      argv: arguments.
      prog, description: of the help text.

    Raises:
      ValueError: an option is unknown or its value cannot be read.
      SystemExit: with code 0, after ``--help``.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            filled, unknown = tyro.cli(
                options, args=list(argv), prog=prog, description=description, return_unknown_args=True
            )
    except SystemExit as leaving:
        if not leaving.code:
            raise
        problem = _first_paragraph(said.getvalue())
        needed = re.match(r"Missing from .*?(--[\w.-]+)", problem)
        problem = f"{prog} needs the option {needed[1]}" if needed else problem
        raise ValueError(f"{problem}; {prog} --help lists the options") from None
    if unknown:
        name = unknown[0].split("=")[0]
        near = did_you_mean(name, [f"--{known}" for known in _names(options, filled)])
        raise ValueError(f"there is no option {name}: {near}{prog} --help lists them")
    return filled


def import_modules(names: Sequence[str]) -> None:
    """Import modules that register environments or algorithms.

    Args:
      names: dotted names, found from the working directory too, or paths of ``.py`` files.

    Raises:
      ValueError: there is no such module or file. What a module itself raises is passed on.
    """
    for name in names:
        if name.endswith(".py"):
            _import_file(Path(name))
        else:
            _import_name(name)


def _import_file(path: Path) -> None:
    if not path.is_file():
        raise ValueError(f"there is no file {str(path)!r} to import: check the path")
    path = path.resolve()
    if "." in path.stem or not _is_free(path.stem, path):
        raise ValueError(f"{str(path)!r} cannot be imported as {path.stem!r}, a name that is taken: rename the file")
    _search(path.parent)
    importlib.import_module(path.stem)


def _is_free(name: str, path: Path) -> bool:
    """No other file is or would be imported by this name."""
    found = sys.modules[name].__spec__ if name in sys.modules else importlib.util.find_spec(name)
    return found is None or found.origin == str(path)


def _import_name(name: str) -> None:
    _search(Path.cwd())
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise
        raise ValueError(
            f"there is no module {name!r} to import: check the name, or give the path of a .py file"
        ) from None


def _search(folder: Path) -> None:
    """Find modules in a folder, after all other places."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
        importlib.invalidate_caches()


def _names(options: Any, filled: Any, prefix: str = "") -> Iterator[str]:
    """Long names of the options of nested dataclasses."""
    for field in dataclasses.fields(options):
        value, name = getattr(filled, field.name), prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _names(value, value, f"{name}.")
        else:
            yield "import" if name == "imports" else name


def _first_paragraph(box: str) -> str:
    """What the parser's box says between its title and its next rule, as one line."""
    _, *lines = re.sub(r"\x1b\[[0-9;]*m", "", box).strip().splitlines()
    said = "\n".join(line.strip("│ ") for line in lines)
    paragraphs = [part for part in re.split(r"^[╭╰─-]*[─-]{3,}[╯]?$", said, flags=re.MULTILINE) if part.strip()]
    return re.sub(r"\s+", " ", paragraphs[0]).strip().rstrip(".")


__all__ = ["Imports", "import_modules", "parse"]
