"""Command-line options for the fields of a configuration, with help texts from its docstring."""

import dataclasses
import inspect
import re
import typing
from typing import Annotated, Any

import tyro


def option_group(config: Any) -> Any:
    """Build a dataclass instance for tyro with the fields of a configuration, annotated with help texts.

    tyro's own docstring parser finds no help where one entry documents several fields (``adam_b1, adam_b2: of all
    optimizers``).

    Args:
      config: dataclass instance. Its values become the defaults.

    Returns:
      An instance of a new dataclass with the same field names. It is ``config`` itself if its type hints cannot be
      resolved.
    """
    kind = type(config)
    try:
        hints = typing.get_type_hints(kind, include_extras=True)
    except NameError:  # a string annotation that only a type checker can resolve
        return config
    texts = field_help(kind)
    fields = []
    for field in dataclasses.fields(config):
        hint = hints[field.name]
        if text := texts.get(field.name):
            hint = Annotated[hint, tyro.conf.arg(help=text)]
        fields.append((field.name, hint, dataclasses.field(default=getattr(config, field.name))))
    return dataclasses.make_dataclass(kind.__name__, fields, frozen=True, kw_only=True)()


def with_options(config: Any, group: Any) -> Any:
    """Return a copy of the configuration with the parsed values of its option group.

    Args:
      config: the configuration.
      group: what ``option_group(config)`` returned, with the values that the parser set.

    Raises:
      ValueError: from the configuration's own checks.
    """
    return dataclasses.replace(
        config, **{field.name: getattr(group, field.name) for field in dataclasses.fields(group)}
    )


def field_help(kind: type) -> dict[str, str]:
    """Docstring entries of a dataclass's fields, by name. Entries of a class override those of its bases."""
    found: dict[str, str] = {}
    for part in reversed(kind.__mro__):
        if part is not object:
            found |= _attributes(part.__doc__ or "")
    names = {field.name for field in dataclasses.fields(kind)}
    return {name: text for name, text in found.items() if name in names}


def _attributes(docstring: str) -> dict[str, str]:
    """Entries of a docstring's section ``Attributes:``, by name."""
    section = re.search(r"^Attributes:\n((?: .*\n|\n)*)", inspect.cleandoc(docstring) + "\n", flags=re.MULTILINE)
    entries = re.split(r"^  (?=[a-z_])", section[1], flags=re.MULTILINE)[1:] if section else []
    found = {}
    for entry in entries:
        names, _, text = entry.partition(":")
        found |= {name.strip(): " ".join(text.split()) for name in names.split(",")}
    return found


__all__ = ["field_help", "option_group", "with_options"]
