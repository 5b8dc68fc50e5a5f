"""Search spaces of hyper-parameters from TOML: options of an algorithm and their ranges."""

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rewax.agents.config import RunConfig, Value
from rewax.agents.legal import legal_values
from rewax.agents.registry import algorithm

Space: TypeAlias = Mapping[str, "Range"]
"""Ranges by the name of the option."""
_FORM = "write {low = ..., high = ...}, with log = true if you like, or {choices = [...]}"


class Range(NamedTuple):
    """Values of an option: ``choices``, or numbers from ``low`` to ``high``, which are integers if both limits are."""

    low: int | float = 0
    high: int | float = 0
    log: bool = False
    choices: tuple[Value, ...] = ()

    @property
    def integers(self) -> bool:
        return isinstance(self.low, int) and isinstance(self.high, int)

    def holds(self, value: object) -> bool:
        """Whether a value is in the range."""
        if self.choices:
            return value in self.choices
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            return False
        return self.low <= value <= self.high and (not self.integers or isinstance(value, int))

    def stored(self, value: Value) -> Any:
        """The number that a study stores for a value; for a choice its index."""
        return self.choices.index(value) if self.choices else value

    def value(self, stored: Any) -> Value:
        """The value for a stored number."""
        return self.choices[stored] if self.choices else stored


def read_space(name: str, path: str | Path | None = None) -> dict[str, Range]:
    """The search space of an algorithm.

    Args:
      name: of the algorithm, and of its table in the file.
      path: of a TOML file; None: the one of the package.

    Raises:
      ValueError: there is no such file or table, or it has a wrong entry; one sentence.
    """
    file = resources.files("rewax.training.tuning") / "spaces.toml" if path is None else Path(path)
    if not file.is_file():
        raise ValueError(f"there is no file {str(path)!r} with a search space: check the path")
    try:
        content = tomllib.loads(file.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not TOML ({error}): correct it") from None
    table = content.get(name)
    if not isinstance(table, Mapping) or not table:
        where = "rewax has no search space" if path is None else f"{path} has no table [{name}]"
        raise ValueError(
            f"{where} for {name}: write a table [{name}] with its options in a TOML file, and give --space"
        )
    return {option: _legal_range(name, option, entry) for option, entry in table.items()}


def _legal_range(name: str, option: str, entry: Any) -> Range:
    config_type = algorithm(name).config_type
    if option not in {field.name for field in dataclasses.fields(config_type)}:
        raise ValueError(f"{name} has no option {option!r}: correct the search space")
    if option == "num_iterations":
        raise ValueError("num_iterations follows from the control steps of a trial: leave it out, and give --steps")
    found = _range(option, entry)
    if (legal := legal_values(config_type).get(option)) is not None:
        for value in found.choices or (found.low, found.high):
            legal.check(f"{option} in the search space", value)
    return found


def _range(option: str, entry: Any) -> Range:
    if not isinstance(entry, Mapping) or set(entry) not in ({"choices"}, {"low", "high"}, {"low", "high", "log"}):
        raise ValueError(f"the search space of {option} is {entry!r}: {_FORM}")
    if "choices" in entry:
        choices = entry["choices"]
        if not isinstance(choices, list) or not choices:
            raise ValueError(f"choices of {option} are {choices!r}: give a list with at least one entry")
        return Range(choices=tuple(tuple(one) if isinstance(one, list) else one for one in choices))
    low, high, log = entry["low"], entry["high"], entry.get("log", False)
    numbers = all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in (low, high))
    if not numbers or not isinstance(log, bool) or not low < high or (log and low <= 0):
        raise ValueError(
            f"the search space of {option} is {dict(entry)!r}: give finite numbers low < high, above 0 with log = true"
        )
    return Range(low, high, log)


def preset_values(space: Space, config: RunConfig) -> dict[str, Value]:
    """The values of a configuration that lie in the space, as a study stores them."""
    values = {name: getattr(config, name) for name in space}
    return {name: where.stored(values[name]) for name, where in space.items() if where.holds(values[name])}


__all__ = ["Range", "Space", "preset_values", "read_space"]
