"""``--env-from``: an environment with parameters that ``rewax identify`` found; a resumed run keeps its own."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from rewax.envs.randomize.stored import part_for_environments, read_result, with_result
from rewax.envs.registry import default_scale

DEFAULT_ENV = "RollingFlat"
_OF_SENSORS = ("sensors", "resolution")


class EnvArguments(NamedTuple):
    """Arguments of ``rewax.make``."""

    env: str
    scale: str
    kwargs: dict[str, Any]


def env_arguments(
    env: str | None, scale: str | None, result: str, use: str, recorded: Mapping[str, Any]
) -> EnvArguments:
    """How to make the environment of a run.

    Args:
      env, scale: as given on the command line; None: those of the result, else the defaults.
      result: file of ``rewax identify``; "" for none.
      use: ``"draws"`` or ``"values"``.
      recorded: contents of ``config.json`` of the run that is resumed; empty for a new run.

    Raises:
      ValueError: in one sentence: a bad result, or the run to be resumed has other parameters.
    """
    if not result:
        if use == "values":
            raise ValueError("--env-from-values takes values from a result: give --env-from RESULT.json")
        env = env or DEFAULT_ENV
        kwargs = recorded.get("env_kwargs") if recorded.get("env") == env else None
        return EnvArguments(env, scale or default_scale(), dict(kwargs) if isinstance(kwargs, Mapping) else {})
    env, scale, given = _made_by(env, scale, result)
    if "identified" in given:
        raise ValueError(
            f"{result!r} was fitted in an environment that had parameters of another result: name all unknowns in one "
            "fit, or register an environment of your own (--import)"
        )
    kwargs = {**given, "identified": part_for_environments(result, use)}
    stored = recorded.get("env_kwargs") or {}
    if recorded and {name: value for name, value in stored.items() if name not in _OF_SENSORS} != kwargs:
        raise ValueError(
            f"the run to be resumed has other parameters than {result!r}: leave --env-from out, the run keeps its own"
        )
    return EnvArguments(env, scale, {**kwargs, **stored})


def env_and_scale(env: str | None, scale: str | None, result: str) -> tuple[str, str]:
    """Environment and scale of a run; arguments as for ``env_arguments``."""
    return _made_by(env, scale, result)[:2] if result else (env or DEFAULT_ENV, scale or default_scale())


def _made_by(env: str | None, scale: str | None, result: str) -> tuple[str, str, dict[str, Any]]:
    """Environment, scale and further arguments of ``rewax.make``: those that a result was fitted with, unless given."""
    made_by = read_result(result)["made_by"] or {}
    same = env in (None, made_by.get("env")) and scale in (None, made_by.get("scale")) and bool(made_by)
    given = dict(made_by["kwargs"]) if same else {}
    scale = scale or (made_by.get("scale") if same else None) or default_scale()
    return str(env or made_by.get("env") or DEFAULT_ENV), str(scale), given


def sentences(env: Any, told: Mapping[str, Any]) -> list[str]:
    """Numbers that an environment took from a result, in words, and a note if its substep is too long for them."""
    from rewax.identify.unknowns import is_stable

    texts, high = [], {}
    drawn = told["use"] == "draws"
    for one in told["unknowns"]:
        label, posterior = one["names"][0], one["posterior"]
        value, short = told["values"][label], label.split(".")[-1]
        kind = "log_std" if "log_std" in posterior else "std"
        texts.append(f"{short} {value:.4g}" + drawn * f" (drawn at every reset, {kind} {posterior[kind]:.2g})")
        far = value * math.exp(2.0 * posterior[kind]) if kind == "log_std" else value + 2.0 * posterior[kind]
        high[label] = min(far, posterior.get("high", math.inf))
    furthest = with_result(env.env, {**told, "use": "values", "values": high}) if drawn else env
    said = [f"identified: {', '.join(texts)}"]
    if not is_stable(furthest):
        said.append(
            "note: the substep is too long for some of these parameters; such episodes end with INVALID_PARAMETERS: "
            "fit and train with a larger num_substeps"
        )
    return said


__all__ = ["DEFAULT_ENV", "EnvArguments", "env_and_scale", "env_arguments", "sentences"]
