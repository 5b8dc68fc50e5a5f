"""``rewax completion``: a script for a shell that completes commands, options, environments and algorithms."""

import contextlib
import dataclasses
import importlib
import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence

import tyro

from rewax.agents.registry import list_algorithms
from rewax.cli.options import parse
from rewax.envs.registry import SCALES, list_envs

SHELLS = ("bash", "zsh")
_SCRIPT = """\
# rewax's commands for {shell}: eval "$(rewax completion {shell})" in ~/.{shell}rc
{prelude}_rewax() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} words=
    # `=` is a word of its own in bash: --env=Ro, --env= and --env Ro are completed alike.
    [[ $word == = ]] && word=
    [[ $before == = ]] && before=${{COMP_WORDS[COMP_CWORD-2]}}
    COMPREPLY=()
    if (( COMP_CWORD == 1 )); then
        words={commands}
    else
        case $before in
{values}
        esac
        if [[ -z $words && $word == -* ]]; then
            case ${{COMP_WORDS[1]}} in
{options}
            esac
        fi
    fi
    if [[ -n $words ]]; then
        COMPREPLY=($(compgen -W "$words" -- "$word"))
    else
        # A name in each line: names may hold spaces. bash 3 and zsh have no `mapfile -t`.
        while IFS= read -r word; do COMPREPLY+=("$word"); done < <(compgen -f -- "$word")
    fi
}}
complete -o filenames -F _rewax rewax
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      shell: bash or zsh.
    """

    shell: tyro.conf.Positional[str]


def run(argv: Sequence[str]) -> int:
    """Print the script.

    Raises:
      ValueError: there is no script for this shell; one sentence.
    """
    from rewax.cli.main import COMMANDS

    options = parse(Options, argv, prog="rewax completion", description="Print a script that completes in a shell.")
    if options.shell not in SHELLS:
        raise ValueError(f"there is no completion for {options.shell!r}: use one of {', '.join(SHELLS)}")
    values = {"--env": list_envs(), "--scale": list(SCALES), "--algo": list_algorithms()}
    known = {name: option_names(name, home) for name, home in COMMANDS.items()}
    print(
        _SCRIPT.format(
            shell=options.shell,
            prelude="autoload -U +X bashcompinit && bashcompinit\n" if options.shell == "zsh" else "",
            commands=_quoted(COMMANDS),
            values="\n".join(_case(values, 12)),
            options="\n".join(_case(known, 16)),
        ),
        end="",
    )
    return 0


def option_names(command: str, home: str) -> list[str]:
    """Options of a command as its help lists them; for ``train`` those of every algorithm."""
    calls = [["--algo", name, "--help"] for name in list_algorithms()] if command == "train" else [["--help"]]
    module = importlib.import_module(home)
    return sorted({name for argv in calls for name in _listed(module, argv)})


def _listed(module: object, argv: list[str]) -> Iterator[str]:
    text, width = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "500"  # no line break within an option
    try:
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            module.run(argv)  # type: ignore[attr-defined]
    finally:
        os.environ.pop("COLUMNS")
        if width is not None:
            os.environ["COLUMNS"] = width
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue())
    for cell in re.split(r"[│\n]| {3,}", plain):  # the help may put two boxes side by side
        first = re.match(r" *((?:-h, )?--[\w.-]+(?: \S+)*(?:, --[\w.-]+)*)", cell)
        if first:
            yield from re.findall(r"--[a-z][\w.-]*", re.split(r"  ", first[1])[0])


def _case(choices: Mapping[str, Sequence[str]], indent: int) -> list[str]:
    """Branches of a shell's ``case``."""
    return [f"{' ' * indent}{name}) words={_quoted(words)} ;;" for name, words in choices.items()]


def _quoted(words: Sequence[str] | Mapping[str, str]) -> str:
    return "'" + " ".join(words) + "'"


__all__ = ["SHELLS", "option_names", "run"]
