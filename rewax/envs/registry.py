"""Environments by name and scale."""

import difflib
import inspect
import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import jax_versions
from rewax.envs.base import Env
from rewax.envs.factories import check_name_and_factory, imported
from rewax.physics.numerics.checks import shown

Scale = str
SCALES: tuple[Scale, ...] = ("paper", "small")
"""``paper`` has the constants of the paper and is for an accelerator. ``small`` learns within minutes on two cores."""

Factory: TypeAlias = Callable[..., Env] | str
"""A function that builds an environment, or its name: ``"package.module:function"``."""

_FACTORIES: dict[str, Factory | Mapping[Scale, Factory]] = {}


def register(name: str, factory: Factory | Mapping[Scale, Factory]) -> None:
    """Make an environment available to ``make`` and to the command line.

    Args:
      name: the name that users pass to ``make``.
      factory: called as ``factory(scale=..., **kwargs)``. A string ``"package.module:function"`` is imported when the
        environment is first made. A mapping gives each scale a factory of its own, called as ``factory(**kwargs)``.

    Raises:
      ValueError: the name is no string or is taken by another factory; a factory is neither a function nor a string of
        that form; or a mapping is empty, or has a key that is no string.
    """
    if isinstance(factory, Mapping) and (not factory or not all(isinstance(scale, str) for scale in factory)):
        scales = ", ".join(map(repr, factory)) or "none"
        raise ValueError(f"the scales of {name!r} are {scales}: give each a name, {{'small': ..., 'paper': ...}}")
    for one in factory.values() if isinstance(factory, Mapping) else (factory,):
        check_name_and_factory("an environment", name, one)
    if _FACTORIES.get(name, factory) != factory:
        raise ValueError(f"an environment named {name!r} is registered already: choose another name")
    _FACTORIES[name] = factory


def list_envs() -> list[str]:
    """The names of all registered environments, sorted."""
    return sorted(_FACTORIES)


def default_scale() -> Scale:
    """``"paper"`` where JAX found an accelerator, ``"small"`` on a CPU."""
    return "small" if jax.default_backend() == "cpu" else "paper"


def make(
    name: str,
    *,
    scale: Scale | None = None,
    identified: str | Path | Mapping[str, Any] | None = None,
    **kwargs: Any,
) -> Env:
    """Build a registered environment.

    The attribute ``made_by`` of the environment is a dict with the keys ``env``, ``scale`` and ``kwargs``: the
    arguments of this call. Environments that ``replace``, ``jit``, ``vmap`` or ``jax.tree.map`` return have no such
    attribute, because their parameters may differ. The first call warns if JAX is newer than the tested versions.

    Args:
      name: one of ``list_envs()``.
      scale: ``"paper"``, ``"small"``, or None for the one that suits the device (``default_scale``).
      identified: JSON file that ``rewax identify`` wrote: the environment has the values found. ``made_by`` holds them,
        not the name of the file. To draw parameters instead, see ``rewax.envs.randomize.identified``.
      **kwargs: options of the environment. Every task of rewax takes ``dt``, a substep [s], and ``num_substeps``, which
        keep the control step: a shorter substep takes more of them. Both together change the control step. Every
        environment with ``world(physics, up)`` takes ``sensors``, names of ``rewax.envs.named_sensors.list_sensors()``:
        their observations are added. Then it also takes ``resolution``, pixels along each side of pictures.

    Returns:
      The environment, unbatched and without auto-reset; with ``sensors`` a ``Sensing``.

    Raises:
      ValueError: a name, a scale or an option is unknown, or an option has an illegal value.

    Example:
      >>> env = make("RollingFlat", sensors=("camera",), resolution=64)
    """
    jax_versions.warn_if_untested()
    scale = default_scale() if scale is None else scale
    chosen = factory_of(name, scale)
    sensing, own = _sensor_options(chosen, kwargs)
    given = own if isinstance(_FACTORIES[name], Mapping) else {"scale": scale, **own}
    _check_keywords(name, chosen, given)
    env = _call(name, chosen, given)
    if missing := _missing_methods(env):
        raise ValueError(
            f"the factory of {name!r} returned {str(env)[:80]!r}, which has no method {missing[0]}: return an "
            "environment, see rewax.envs.base.Env"
        )
    if isinstance(env, type):
        raise ValueError(f"the factory of {name!r} returned the class {env.__name__}: return an environment of it")
    if identified is not None:
        from rewax.envs.randomize.stored import part_for_environments, with_result

        kwargs = {**kwargs, "identified": part_for_environments(identified)}
        env = with_result(env, kwargs["identified"])
    if sensing:
        from rewax.envs.named_sensors import with_sensors

        env = with_sensors(env, **sensing)
    _attach(env, {"env": name, "scale": scale, "kwargs": {key: _plain(value) for key, value in kwargs.items()}})
    return env


def recipe(env: Env) -> dict[str, Any] | None:
    """``env.made_by``, or None if there is none that JSON can hold."""
    made_by = getattr(env, "made_by", None)
    try:
        json.dumps(made_by)
    except (TypeError, ValueError):
        return None
    return made_by


def factory_of(name: str, scale: Scale | None = None) -> Callable[..., Env]:
    """The function that builds an environment; a scale of None stands for any.

    Raises:
      ValueError: unknown name or scale, or the factory cannot be imported or is no function.
    """
    check_name(name)
    factory = _FACTORIES[name]
    scales = tuple(factory) if isinstance(factory, Mapping) else SCALES
    if scale is not None and (not isinstance(scale, str) or scale not in scales):
        raise ValueError(
            f"scale is {scale!r}: {did_you_mean(scale, scales)}use one of {', '.join(map(repr, scales))}, or none to "
            "follow the device"
        )
    return imported(name, factory[scale or scales[0]] if isinstance(factory, Mapping) else factory)


def check_name(name: str) -> None:
    """Raise a ValueError unless ``make`` knows the name."""
    if not isinstance(name, str) or name not in _FACTORIES:
        raise ValueError(
            f"there is no environment named {name!r}: {did_you_mean(name, _FACTORIES)}known are "
            f"{', '.join(list_envs())}; register others first, on the command line with --import MODULE"
        )


def did_you_mean(name: Any, known: Iterable[str]) -> str:
    """``"did you mean 'x'? "`` with the known name that is most similar, ``""`` if none is similar."""
    by_lower_case = {other.lower(): other for other in known}
    if str(name).lower() in by_lower_case:
        return f"did you mean {by_lower_case[str(name).lower()]!r}? "
    close = difflib.get_close_matches(str(name), list(by_lower_case.values()), n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}? " if close else ""


def require_env(env: Any, name: str = "env") -> None:
    """Raises ValueError unless a value has the methods of an environment; ``name`` is that of the argument."""
    if isinstance(env, type) or _missing_methods(env):
        known = env if isinstance(env, str) and env in _FACTORIES else "RollingFlat"
        raise ValueError(f"{name} is {shown(env)}: give an environment, rewax.make({known!r}) for example")


def _missing_methods(env: Any) -> list[str]:
    return [method for method in ("reset", "step") if not callable(getattr(env, method, None))]


def _sensor_options(factory: Callable[..., Env], given: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The arguments of ``with_sensors``, empty for no sensors, and those of a factory, which may have such itself."""
    if "sensors" not in given or "sensors" in _keywords(factory):
        return {}, dict(given)
    own = dict(given)
    names = own.pop("sensors")
    unused = not names and own.get("resolution") is not None  # left to the factory, or refused with its options
    resolution = None if unused or "resolution" in _keywords(factory) else own.pop("resolution", None)
    return {"names": names, "resolution": resolution} if names else {}, own


def _keywords(factory: Callable[..., Env]) -> set[str]:
    """Names of the parameters of a factory; some callables written in C have none."""
    try:
        return set(inspect.signature(factory).parameters)
    except (TypeError, ValueError):
        return set()


def _check_keywords(name: str, factory: Callable[..., Env], given: Mapping[str, Any]) -> None:
    """Raises ValueError unless the factory takes these keywords. A factory with ``**kwargs`` takes any."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):  # some callables written in C have none
        return
    by_keyword = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    legal = {p.name: p.default is p.empty for p in parameters if p.kind in by_keyword}
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters)
    for keyword in () if takes_any else [keyword for keyword in given if keyword not in legal]:
        if keyword == "scale":
            raise ValueError(f"the factory of {name!r} takes no scale: define it as factory(*, scale, ...)")
        if keyword == "resolution":
            raise ValueError("resolution is that of pictures: give it together with sensors=('camera',)")
        raise ValueError(_no_option(name, keyword, [known for known in legal if known != "scale"]))
    missing = [keyword for keyword, required in legal.items() if required and keyword not in given]
    if missing:
        raise ValueError(f"{name} needs the option {missing[0]!r}: give make({name!r}, {missing[0]}=...)")


def _no_option(name: str, keyword: str, legal: list[str]) -> str:
    use = f"use {', '.join(legal)}" if legal else "it has none"
    return f"{name} has no option {keyword!r}: {did_you_mean(keyword, legal)}{use}"


def _call(name: str, factory: Callable[..., Env], given: Mapping[str, Any]) -> Env:
    """Call a factory. One that passes ``**kwargs`` on may refuse a misspelt keyword only inside."""
    try:
        return factory(**given)
    except TypeError as error:
        refused = re.search(r"got an unexpected keyword argument '(\w+)'", str(error))
        if refused and refused[1] in given:
            raise ValueError(f"{name} has no option {refused[1]!r}: {error}") from error
        raise


def _plain(value: Any) -> Any:
    """A number of Python for one of NumPy, or for a concrete scalar of JAX."""
    if not isinstance(value, (np.generic, np.ndarray, jax.Array)) or isinstance(value, Tracer):
        return value
    is_number = jnp.issubdtype(value.dtype, jnp.number) or jnp.issubdtype(value.dtype, jnp.bool_)
    return value.item() if np.ndim(value) == 0 and is_number else value


def _attach(env: Env, made_by: dict[str, Any]) -> None:
    """Set ``made_by`` on an environment, also on a frozen one. Objects that take no attributes get none."""
    try:
        object.__setattr__(env, "made_by", made_by)
    except AttributeError:
        return


__all__ = [
    "SCALES", "Factory", "Scale", "default_scale", "did_you_mean", "list_envs", "make", "recipe", "register",
    "require_env",
]  # fmt: skip
