"""Command-line arguments: parsed into dataclasses; every mistake is one sentence."""

import contextlib
import dataclasses
import difflib
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import tyro

from rewax.agents.legal import check_fields
from rewax.agents.registry import list_algorithms
from rewax.envs import registry
from rewax.envs.base import Env
from rewax.envs.registry import did_you_mean
from rewax.training.storage.modules import import_modules, user_error

T = TypeVar("T")
Imports: TypeAlias = tyro.conf.UseAppendAction[
    Annotated[tuple[str, ...], tyro.conf.arg(name="import", metavar="MODULE")]
]
"""Field of the options ``--import``, which may be repeated."""


def one_of(run: str | None, run_dir: str | None, needed: str) -> str:
    """The run that is given as a word or as the option ``--run-dir``.

    Raises:
      ValueError: neither or both are given; ``needed`` is the sentence.
    """
    where = run or run_dir
    if where is None or (run and run_dir):
        raise ValueError(needed)
    return where


def parse(options: type[T], argv: Sequence[str], *, prog: str, description: str) -> T:
    """Fill a dataclass from arguments.

    Args:
      options: dataclass with a default for every optional field.
      argv: arguments.
      prog, description: name and description in the help text.

    Raises:
      ValueError: an option is unknown, or its value cannot be read or is not legal for the field's type.
      SystemExit: with code 0, after ``--help``.
    """
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            filled, unknown = tyro.cli(
                options, args=list(argv), prog=prog, description=description, return_unknown_args=True
            )
    except SystemExit as leaving:
        if not leaving.code:
            raise
        problem = _first_paragraph(output.getvalue())
        needed = re.match(r"Missing from .*?(--[\w.-]+)", problem)
        word = re.match(r"Missing from .*?: \w+ +(.*?)\.? \(required\)", problem)
        if needed:
            problem = f"{prog} needs the option {needed[1]}"
        elif word:
            problem = f"{prog} needs one word more: {word[1]}"
        else:
            problem = _readable(problem)
        raise ValueError(f"{problem}; {prog} --help lists the options") from None
    if unknown:
        name = unknown[0].split("=")[0]
        if not name.startswith("-"):
            raise ValueError(_stray(unknown[0], list(argv), list(_names(options, filled, kind=bool)), prog))
        near = did_you_mean(name, [f"--{known}" for known in _names(options, filled)])
        raise ValueError(f"there is no option {name}: {near}{prog} --help lists them")
    check_fields(filled)
    return filled


def names_of(directories: Sequence[str]) -> list[str]:
    """The last part of each run's path; the whole path if several have the same last part."""
    last = [Path(directory).resolve().name for directory in directories]
    return [
        name if last.count(name) == 1 else str(directory) for name, directory in zip(last, directories, strict=True)
    ]


def build_env(name: str, scale: str, **kwargs: Any) -> Env:
    """A registered environment.

    Raises:
      ValueError: in one sentence: there is none of this name or scale, or its factory raised an exception.
    """
    try:
        return registry.make(name, scale=scale, **kwargs)
    except ValueError:
        raise
    except Exception as error:
        known = user_error(error, f"building {name} at scale {scale}")
        if " failed at " not in str(known):  # not in a user's code
            raise
        raise known from error


def _stray(word: str, argv: list[str], flags: list[str], prog: str) -> str:
    """A sentence about a word that belongs to no option; ``flags`` are the names of options without a value."""
    for before, after in zip(["", *argv], argv, strict=False):
        given, _, value = (f"{before}={after}" if after == word else after).partition("=")
        *group, name = given.removeprefix("--").split(".")
        plain = ".".join([*group, name.removeprefix("no-")])
        if value == word and plain in flags:
            opposite = ".".join([*group, f"no-{name}"]) if name == name.removeprefix("no-") else plain
            return f"{given} takes no value, but {word!r} was given: write {given}, or --{opposite} for the opposite"
    near = ""
    for option, known in (("--env", registry.list_envs()), ("--algo", list_algorithms())):
        close = difflib.get_close_matches(word, known, n=1, cutoff=0.7)
        if close and not near:
            near = f"did you mean {option} {close[0]}? "
    return f"{prog} takes no argument {word!r}: {near}{prog} --help lists the options"


def _readable(problem: str) -> str:
    """The parser's sentence about a value, in the form of rewax's own: the option, the value, the remedy."""
    if found := re.match(r"invalid choice (.*) for argument '(--.*)'. Expected one of \((.*?),?\)$", problem):
        choices = re.findall("'([^']*)'", found[3])
        return f"{found[2]} is {found[1]}: use {' or '.join(choices)}"
    if found := re.match(r"Missing value for argument '(--.*)'. Expected (\d+) values", problem):
        return f"{found[1]} lacks a value: give {found[2]} after it"
    if found := re.match(r"Error parsing (--[\w.-]+): (.*)$", problem):
        option, why = found.groups()
        value = next(iter(re.findall(r"\['(.*?)'\]|: '(.*)'$", why)), ("", ""))
        kinds = {"base 10": "an integer", "to float": "a number", "valid parse": "numbers, each after a space"}
        remedy = next((kind for sign, kind in kinds.items() if sign in why), "")
        return f"{option} is {''.join(value)!r}: give {remedy}{', or None' * ('{None}' in why)}" if remedy else problem
    return re.sub(r"^Error parsing [\w.-]+: ", "", problem)  # the dataclass's own sentence


def _names(options: Any, filled: Any, prefix: str = "", kind: type = object) -> Iterator[str]:
    """Long names of the options of nested dataclasses with values of this type."""
    for field in dataclasses.fields(options):
        value, name = getattr(filled, field.name), prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _names(value, value, f"{name}.", kind)
        elif isinstance(value, kind):
            yield {"imports": "import", "settings": "set"}.get(name, name)


def _first_paragraph(box: str) -> str:
    """The first paragraph in the parser's box of text, below its title, as one line."""
    _, *lines = re.sub(r"\x1b\[[0-9;]*m", "", box).strip().splitlines()
    text = "\n".join(line.strip("│ ") for line in lines)
    paragraphs = [part for part in re.split(r"^[╭╰─-]*[─-]{3,}[╯]?$", text, flags=re.MULTILINE) if part.strip()]
    return re.sub(r"\s+", " ", paragraphs[0]).strip().rstrip(".")


__all__ = ["Imports", "build_env", "import_modules", "parse"]
