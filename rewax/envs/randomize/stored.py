"""The file of ``rewax identify`` as environments read it: values of parameters, and distributions of them."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from rewax.envs.copied_geoms import check_colliders
from rewax.envs.randomize.distributions import LogNormal, LogUniform, Normal, Scale, Shift, Uniform
from rewax.envs.randomize.hooks import Draw, LeafDraws, with_numbers
from rewax.envs.randomized import Randomized, check_hook

FORMAT = "rewax identified 1"
USES = ("values", "draws")
"""An environment has the values found, or draws parameters from the distributions found at every reset."""
_DISTRIBUTIONS = {kind.__name__: kind for kind in (LogNormal, LogUniform, Normal, Uniform)}
_CHANGES = {kind.__name__: kind for kind in (Scale, Shift)}
_REMEDY = "give the JSON file that `rewax identify` wrote"


def read_result(path: str | Path) -> dict[str, Any]:
    """The contents of a file that ``Identified.save`` wrote.

    Raises:
      ValueError: in one sentence: there is no such file, or it is no result.
    """
    if not isinstance(path, (str, os.PathLike)) or not Path(path).is_file():
        raise ValueError(f"there is no result {str(path)!r}: {_REMEDY}")
    path = Path(path)
    try:
        found = json.loads(path.read_text())
        if found["format"] != FORMAT:
            raise KeyError("format")
        draws_of(found["unknowns"])
        return {"made_by": None, **found, "values": {name: float(value) for name, value in found["values"].items()}}
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError, UnicodeDecodeError):
        raise ValueError(f"{str(path)!r} is no result of this version: {_REMEDY}") from None


def identified(path: str | Path) -> LeafDraws:
    """A hook that draws parameters from the distributions that ``rewax identify`` found, for ``randomize=``.

    Correlations between parameters are left out.

    Raises:
      ValueError: in one sentence: there is no such file, or it is no result.

    Example:
      >>> agent = make_sapo(env, config, randomize=identified("push.json"))  # doctest: +SKIP
    """
    return draws_of(read_result(path)["unknowns"])


def part_for_environments(result: str | Path | Mapping[str, Any], use: str = "values") -> dict[str, Any]:
    """The entries of a result that an environment is made from: ``use``, ``values`` and ``unknowns``.

    Args:
      result: a file of ``rewax identify``, or these entries themselves, whose ``use`` then counts.
      use: of ``USES``.

    Raises:
      ValueError: there is no such file, it is no result, or an entry is missing or illegal.
    """
    told = {**result} if isinstance(result, Mapping) else {**read_result(result), "use": use}
    try:
        draws_of(told["unknowns"])
        values = {name: float(told["values"][name]) for name in (one["names"][0] for one in told["unknowns"])}
    except (KeyError, TypeError, AttributeError, IndexError):
        raise ValueError(f"identified is {result!r}, which lacks values or unknowns: {_REMEDY}") from None
    if told.get("use", "values") not in USES:
        raise ValueError(f"use of identified is {told['use']!r}: give one of {', '.join(map(repr, USES))}")
    unknowns = [{name: one[name] for name in ("names", "change", "posterior")} for one in told["unknowns"]]
    return {"use": told.get("use", "values"), "values": values, "unknowns": unknowns}


def with_result(env: Any, told: Mapping[str, Any]) -> Any:
    """An environment with the values found, or one that draws parameters at every reset (``Randomized``).

    Args:
      env: one environment that has these parameters.
      told: of ``part_for_environments``.

    Raises:
      ValueError: the environment lacks a parameter.
    """
    draws = draws_of(told["unknowns"])
    if told["use"] == "draws":
        check_hook(env, draws)
        return Randomized(env=env, randomize=draws)
    found = with_numbers(env, draws, [jnp.float32(told["values"][names[0]]) for names, _ in draws.draws])
    check_colliders(env, found)
    return found


def draws_of(unknowns: Sequence[Mapping[str, Any]]) -> LeafDraws:
    """The hook of a result's entry ``unknowns``."""
    return LeafDraws(tuple((tuple(one["names"]), _read(one["posterior"], one["change"])) for one in unknowns))


def change_of(draw: Draw) -> str:
    """``"Scale"``, ``"Shift"`` or ``""``: how a drawn number changes a parameter."""
    return type(draw).__name__ if isinstance(draw, (Scale, Shift)) else ""


def told(draw: Any) -> dict[str, Any]:
    """A distribution as a dictionary of plain numbers; infinite bounds are left out."""
    by = draw.by if isinstance(draw, (Scale, Shift)) else draw
    fields = {f.name: getattr(by, f.name) for f in dataclasses.fields(by) if f.name != "per"}
    return {"kind": type(by).__name__, **{name: v for name, v in fields.items() if math.isfinite(v)}}


def _read(told: Mapping[str, Any], change: str) -> Draw:
    fields = dict(told)
    distribution = _DISTRIBUTIONS[fields.pop("kind")](**fields)
    return _CHANGES[change](distribution) if change else distribution


__all__ = [
    "FORMAT", "USES", "change_of", "draws_of", "identified", "part_for_environments", "read_result", "told",
    "with_result",
]  # fmt: skip
