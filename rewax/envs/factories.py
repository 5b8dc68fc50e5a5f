"""Factories of environments and sensors: functions, or their names, which are imported on first use."""

import importlib
from collections.abc import Callable
from typing import Any

from rewax.physics.numerics.checks import described

_REMEDY = "give a function or 'package.module:function'"


def check_name_and_factory(kind: str, name: Any, factory: Any) -> None:
    """Raises ValueError unless ``factory`` can be registered under ``name``.

    Args:
      kind: of what the factory makes, with its article: ``"an environment"``.
      name: of what it makes.
      factory: a function, or its name: ``"package.module:function"``. It is not imported here.
    """
    if not isinstance(name, str) or not name.strip():
        raise ValueError(f"the name of {kind} is {described(name)}: give a string")
    if isinstance(factory, str):
        module, colon, function = factory.partition(":")
        if not (colon and all(module.split(".")) and function.isidentifier()):
            raise ValueError(f"the factory of {name!r} is {factory!r}: {_REMEDY}")
    elif not callable(factory):
        raise ValueError(f"the factory of {name!r} is {described(factory)}: {_REMEDY} that returns {kind}")


def imported(name: str, factory: Callable[..., Any] | str) -> Callable[..., Any]:
    """The function that makes what is registered under ``name``.

    Raises:
      ValueError: a string names what cannot be imported, or what is no function.
    """
    if not isinstance(factory, str):
        return factory
    module, function = factory.split(":")
    what = f"the factory of {name!r} is {factory!r}"
    try:
        found = getattr(importlib.import_module(module), function, None)
    except ImportError as error:
        raise ValueError(
            f"{what}, which cannot be imported ({error}): correct its registration, or install what it needs"
        ) from error
    if found is None:
        raise ValueError(f"{what}, but {module} has no {function}: correct its registration")
    if not callable(found):
        raise ValueError(f"{what}, which is {described(found)}: register a function")
    return found


__all__ = ["check_name_and_factory", "imported"]
