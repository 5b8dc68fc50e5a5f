"""Evaluations of one policy over a grid of physical parameters."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax

from rewax.envs.base import Env
from rewax.envs.copied_geoms import check_colliders
from rewax.envs.randomize import Constant, LeafDraws, hook, leaves
from rewax.envs.randomize.hooks import reached
from rewax.envs.randomized import Randomized, changed_by
from rewax.envs.wrappers import _Wrapper

Grid = Mapping[str, tuple[float, ...]]
"""Values by the name of a parameter, as ``rewax.envs.randomize.leaves`` lists them."""


def read_grid(settings: Sequence[str], env: Env) -> dict[str, tuple[float, ...]]:
    """The grid of ``parameter=v1,v2,...`` texts.

    Args:
      settings: a text for each parameter. The end of a name is enough where one parameter alone ends so:
        ``youngs_modulus=400,800`` for ``scene.material.elasticity.youngs_modulus``.
      env: whose parameters these are.

    Raises:
      ValueError: in one sentence: a text of another form, a value that is not a finite number, no such parameter.
    """
    grid: dict[str, tuple[float, ...]] = {}
    for setting in settings:
        name, sign, values = setting.partition("=")
        if not (name and sign and values):
            raise ValueError(f"--set is {setting!r}: write parameter=value or parameter=value1,value2,...")
        full = _full_name(name, env)
        if full in grid:
            raise ValueError(f"--set names {full} twice: give all its values at once, separated by commas")
        grid[full] = tuple(_number(name, value) for value in values.split(","))
    if grid:
        with_parameters(env, {name: values[0] for name, values in grid.items()})
    return grid


def points(grid: Grid) -> Iterator[dict[str, float]]:
    """All combinations of the grid's values; the last parameter changes first."""
    for values in itertools.product(*grid.values()):
        yield dict(zip(grid, values, strict=True))


def with_parameters(env: Env, values: Mapping[str, float]) -> Env:
    """An environment of the same structure with other values of some parameters, which are no longer drawn at resets.

    Raises:
      ValueError: the environment has no such parameter, a function of the user draws it, it is drawn together with
        others that keep their draws, or it would not reach the soft body (``copied_geoms``).
    """
    fixed = hook({name: Constant(value) for name, value in values.items()})(jax.random.key(0), env)
    check_colliders(env, fixed)
    return _without_draws_of([name.removeprefix(".") for name in values], fixed)


def _drawn_by(randomize: Any, env: Any) -> set[str]:
    """Names of the arrays that a hook draws."""
    return set(jax.eval_shape(lambda key: changed_by(randomize, key, env), jax.random.key(0)))


def _without_draws_of(names: Sequence[str], env: Any) -> Any:
    """The environment without the draws of these parameters, at any depth of its wrappers."""
    if not isinstance(env, _Wrapper):
        return env
    inside = [name.removeprefix("env.") for name in names if name.startswith("env.")]
    kept = {}
    if isinstance(env, Randomized) and inside:
        if isinstance(env.randomize, LeafDraws):
            kept = {"randomize": LeafDraws(tuple(d for d in env.randomize.draws if not _is_set(d[0], inside, env.env)))}
        else:
            set_to = hook({name: Constant(0.0) for name in inside})
            if clash := sorted(_drawn_by(set_to, env.env) & _drawn_by(env.randomize, env.env)):
                raise ValueError(
                    f"{clash[0].removeprefix('.')} is drawn at every reset by a function, so it has no "
                    "value to set: draw it with rewax.envs.randomize.hook"
                )
    return dataclasses.replace(env, env=_without_draws_of(inside, env.env), **kept)


def _is_set(drawn: tuple[str, ...], names: Sequence[str], env: Any) -> bool:
    """Whether the parameters of a draw are set. Raises ValueError if only a part of them is."""
    some, every = reached(drawn, names, env)
    if some and not every:
        some_of_it = [name for name in names if reached(drawn, [name], env)[0]]
        raise ValueError(
            f"{', '.join(some_of_it)} is drawn at every reset together with the rest of {', '.join(drawn)}: set all of "
            "it"
        )
    return some


def _full_name(name: str, env: Env) -> str:
    """The name itself if there is such a parameter; else that of the one that ends so, ``[name]`` included."""
    if name in (every := leaves(env)):
        return name
    ends = [known for known in every if known.endswith((f".{name}", f"[{name}]"))]
    return ends[0] if len(ends) == 1 else name


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"--set gives {name} the value {text!r}: give a finite number")
    return value


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows with the same columns as lines of text: names above, columns aligned."""
    cells = [list(rows[0]), *([_text(value) for value in row.values()] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


__all__ = ["Grid", "points", "read_grid", "table", "with_parameters"]
