"""``rewax envs``: the environments that ``--env`` takes; what they are, and the arguments of ``rewax.make``."""

import dataclasses
import inspect
import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from rewax.cli.options import Imports, build_env, import_modules, parse
from rewax.training.storage.modules import user_error


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      envs: names of environments to build and describe with shapes, episode and defaults; none: a table of all.
      scale: of the environments that are described; by default what suits the device.
      names: print names alone, one a line, as is done where the output is no terminal.
      table: print the table there too.
      imports: module or .py file that registers environments.
    """

    envs: tyro.conf.Positional[tuple[str, ...]] = ()
    scale: str | None = None
    names: tyro.conf.FlagCreatePairsOff[bool] = False
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    imports: Imports = ()


def run(argv: Sequence[str]) -> int:
    """Print names, a table, or descriptions.

    Raises:
      ValueError: there is no such environment or scale.
    """
    from rewax.cli.train import quiet
    from rewax.envs import registry

    quiet()
    options = parse(Options, argv, prog="rewax envs", description="List the environments, or describe some of them.")
    import_modules(options.imports)
    for name in options.envs:
        registry.check_name(name)
    if options.envs:
        scale = options.scale or registry.default_scale()
        print("\n\n".join(describe(name, scale) for name in options.envs))
    elif options.names or not (options.table or sys.stdout.isatty()):
        print(*registry.list_envs(), sep="\n")
    else:
        _print_table(registry.list_envs())
    return 0


def describe(name: str, scale: str) -> str:
    """A description: a sentence, observations, actions, length of an episode, sensors, arguments of ``rewax.make``."""
    from rewax.envs.named_sensors import list_sensors

    env: Any = build_env(name, scale)
    observations = ", ".join(f"{key} {spec.shape}" for key, spec in env.observation_spec.items())
    action, dt = env.action_spec, getattr(env, "control_dt", None)
    seconds = "" if dt is None else f" of {float(dt):.4g} s, {env.episode_length * float(dt):.4g} s in all"
    lines = {
        "observations": observations,
        "actions": f"{action.shape}, from {action.low:g} to {action.high:g}",
        "episode": f"{env.episode_length} control steps{seconds}",
        "sensors": ", ".join(list_sensors(env)) or "none",
        "arguments": ", ".join(_arguments(_factory(name, scale), defaults=True)) or "none",
    }
    title = f"{name} at scale {scale}: {summary(name)}"
    return "\n".join([title, *(f"  {what:13s} {text}" for what, text in lines.items())])


def summary(name: str) -> str:
    """A sentence about an environment, from the docstring of its module, or else of its factory."""
    factory = _factory(name)
    module = inspect.getmodule(factory)
    first = _first_sentence(getattr(module, "__doc__", None))
    if first.startswith(f"{name}: "):
        return first.removeprefix(f"{name}: ")
    return _first_sentence(getattr(factory, "__doc__", None)) or first


def _print_table(names: Sequence[str]) -> None:
    table = Table(box=None, pad_edge=False)
    for title, fixed in (("environment", True), ("what it is", False), ("arguments of rewax.make", False)):
        table.add_column(title, no_wrap=fixed, overflow="fold")
    for name in names:
        try:
            row = summary(name), ", ".join(_arguments(_factory(name), defaults=False))
        except ValueError as error:  # of a factory that cannot be imported
            row = str(error), ""
        except Exception as error:  # of the module that it is in
            row = str(user_error(error, "the import of its factory")), ""
        table.add_row(name, *row)
    console = Console(highlight=False, markup=False)
    console.print(table)
    console.print("\nrewax envs NAME builds an environment and prints its observations, actions and defaults.")


def _factory(name: str, scale: str | None = None) -> Callable[..., Any]:
    from rewax.envs import registry

    return registry.factory_of(name, scale)


def _arguments(factory: Callable[..., Any], *, defaults: bool) -> list[str]:
    """Keywords that ``rewax.make`` passes on to a factory, with their defaults or without."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):  # some callables written in C have none
        return []
    named = [p for p in parameters if p.name != "scale" and p.kind is not p.VAR_POSITIONAL]
    return [
        f"**{p.name}" if p.kind is p.VAR_KEYWORD else f"{p.name}={p.default!r}" if defaults and p.default is not p.empty
        else p.name
        for p in named
    ]  # fmt: skip


def _first_sentence(docstring: str | None) -> str:
    """The first paragraph of a docstring on one line."""
    return " ".join((inspect.cleandoc(docstring) if docstring else "").split("\n\n")[0].split())


__all__ = ["Options", "describe", "run", "summary"]
