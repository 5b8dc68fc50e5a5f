"""The hook that draws leaves of an environment, addressed by name."""

import dataclasses
import difflib
import re
import zlib
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.envs.randomize.distributions import Distribution, Per, Scale, Shift
from rewax.types import Array, Key

Draw: TypeAlias = Distribution | Scale | Shift
"""A bare distribution gives the value itself, ``Scale`` a factor of the present one, ``Shift`` a change of it."""
_Names: TypeAlias = str | tuple[str, ...]
_ALL = "*"
_WHOLE = ":"


def hook(draws: Mapping[_Names, Draw]) -> "LeafDraws":
    """A hook for ``Randomized`` and for the ``randomize=`` of every agent.

    Args:
      draws: distributions by the names of leaves, which ``leaves`` lists: ``"scene.material.density"``,
        ``"model.parameters[body_mass]"``. A tuple of names shares each number that is drawn: stiffness and yield
        stress by one factor. ``*`` stands for any part of a name, again with one number for all:
        ``"scene.colliders[*].friction"``. Indices behind a name choose a part of the leaf: ``"scene.gravity[1]"``,
        ``"model.parameters[geom_friction][:,0]"``. With ``Per.ROW`` or ``Per.ELEMENT`` a leaf gets several numbers.

    Raises:
      ValueError: no draws, a name that is no string, or something else than a distribution. Whether the names are those
        of leaves is seen where the environment is known: by the agent when it is made, by the hook when it is called.

    Example:
      >>> stiffness = ("scene.material.elasticity.youngs_modulus", "scene.material.plasticity.yield_stress")
      >>> agent = make_sapo(env, config, randomize=hook({stiffness: Scale(LogUniform(0.5, 1.0))}))  # doctest: +SKIP
    """
    if not isinstance(draws, Mapping) or not draws:
        raise ValueError(f"draws is {draws!r}: give a dict, as in {{'scene.material.density': Uniform(900.0, 1100.0)}}")
    found = []
    for names, draw in draws.items():
        names = (names,) if isinstance(names, str) else names
        if not isinstance(names, tuple) or not names or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{names!r} is no name of a leaf: give a string, or a tuple of strings that share a draw")
        if not isinstance(draw, (Distribution, Scale, Shift)):
            raise ValueError(
                f"the draw of {', '.join(names)} is {draw!r}: give a distribution, Scale(...) or Shift(...)"
            )
        found.append((names, draw))
    return LeafDraws(tuple(found))


def leaves(env: Any) -> dict[str, Any]:
    """The leaves of an environment that can be drawn, by name; floating-point numbers and arrays."""
    named = [(_dotted(path), leaf) for path, leaf in jax.tree.leaves_with_path(env)]
    return {name: leaf for name, leaf in named if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)}


@dataclasses.dataclass(frozen=True)
class LeafDraws:
    """``(key, env) -> env`` with leaves drawn; see ``hook``, which makes it. Equal ones share compiled programs.

    Attributes:
      draws: names that share a draw, and the draw.
    """

    draws: tuple[tuple[tuple[str, ...], Draw], ...]

    def __call__(self, key: Key, env: Any) -> Any:
        """The environment with leaves drawn.

        What one entry draws depends on the key and on its names, and not on the other entries.

        Args:
          key: determines all draws.
          env: one environment.

        Returns:
          An environment of the same structure, shapes and dtypes.

        Raises:
          ValueError: a name of no leaf, a leaf that cannot be drawn so, or one that is drawn twice.

        Gradient: exact with respect to the environment's leaves, see ``Scale`` and ``Shift``; none by the key.
        """
        named, treedef = jax.tree.flatten_with_path(env)
        values, drawn = [leaf for _, leaf in named], set()
        for names, draw in self.draws:
            places = [place for name in names for place in _places(name, named, env)]
            for place in places:
                if place in drawn:
                    raise ValueError(f"{_name(place, named)} is drawn twice: give it one distribution")
                drawn.add(place)
            _check_leaves(places, named, draw)
            by = draw if isinstance(draw, Distribution) else draw.by
            shape = _shape_of_draw(places, named, by.per)
            entry_key = jax.random.fold_in(key, zlib.crc32(" ".join(names).encode()))
            numbers = by.sample(entry_key, shape, jnp.result_type(float))
            for place in places:
                values[place.leaf] = _with_draw(values[place.leaf], place.index, numbers, draw)
        return jax.tree.unflatten(treedef, values)


class _Place(NamedTuple):
    """A leaf, or a part of one."""

    leaf: int
    """Index among the environment's leaves."""
    index: tuple[int | None, ...]  # pyright: ignore[reportIncompatibleMethodOverride]
    """Into the leaf's first axes; None takes all of an axis."""


def _places(name: str, named: list[tuple[Any, Any]], env: Any) -> list[_Place]:
    """What a name stands for."""
    wanted = _parts(name)
    found = []
    for i, (path, leaf) in enumerate(named):
        own = _parts(_dotted(path))
        same = len(own) <= len(wanted) and all(a in (b, _ALL) for a, b in zip(wanted, own, strict=False))
        if same and own:
            found.append(_Place(i, _index(name, wanted[len(own) :], _dotted(path), jnp.shape(leaf))))
    if not found:
        raise ValueError(_no_leaf(name, named, env))
    return found


def _index(name: str, parts: list[str], leaf_name: str, shape: tuple[int, ...]) -> tuple[int | None, ...]:
    given = [part.strip() for text in parts for part in text.split(",")]
    if not all(part == _WHOLE or re.fullmatch(r"-?\d+", part) for part in given):
        raise ValueError(f"{name} goes on behind the leaf {leaf_name}: end there, or give indices as in {leaf_name}[0]")
    index = tuple(None if part == _WHOLE else int(part) for part in given)
    inside = len(index) <= len(shape) and all(i is None or -n <= i < n for i, n in zip(index, shape, strict=False))
    if not inside:
        raise ValueError(f"{name} is no part of the leaf {leaf_name}, which has shape {shape}: give indices within it")
    return tuple(None if i is None else i % n for i, n in zip(index, shape, strict=False))


def _no_leaf(name: str, named: list[tuple[Any, Any]], env: Any) -> str:
    """The sentence for a wrong name, with names that are near it: as a whole, or by the end of theirs."""
    known = [_dotted(path) for path, _ in named]
    below = [other for other in known if _parts(other)[: len(_parts(name))] == _parts(name)]
    ends = {other: _parts(other)[-1] for other in known if _parts(other)}
    last = (_parts(name) or [""])[-1]
    by_end = difflib.get_close_matches(last, ends.values(), n=3, cutoff=0.75)
    near = below + [other for other in known if ends.get(other) in by_end]
    near += difflib.get_close_matches(name, known, n=3, cutoff=0.6)
    near.sort(key=lambda other: -difflib.SequenceMatcher(None, name, other).ratio())
    listed = ", ".join(list(dict.fromkeys(near))[:3])
    hint = f"near are {listed}; " if listed else ""
    kind, num = type(env).__name__, len(leaves(env))
    return f"{kind} has no leaf {name!r}: {hint}rewax.envs.randomize.leaves(env) has all {num} by name"


def _check_leaves(places: list[_Place], named: list[tuple[Any, Any]], draw: Draw) -> None:
    """Raises ValueError for leaves that this draw cannot change."""
    for place in places:
        name, leaf = _name(place, named), named[place.leaf][1]
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            kind = jnp.result_type(leaf).name
            raise ValueError(f"{name} is of type {kind}: only floats can be drawn; give the environment a float there")
        if isinstance(draw, Scale) and _is_fixed(leaf, place.index):
            raise ValueError(f"{name} is {leaf}, which no factor changes: give its values, as in Uniform(0.1, 0.5)")


def _is_fixed(leaf: Any, index: tuple[int | None, ...]) -> bool:
    """Whether no factor changes this part of a leaf: zero or infinite. Of a traced leaf that is not known."""
    if isinstance(leaf, Tracer):
        return False
    part = np.asarray(leaf)[_slices(index)]
    return bool(np.all((part == 0.0) | np.isinf(part)))


def _shape_of_draw(places: list[_Place], named: list[tuple[Any, Any]], per: Per) -> tuple[int, ...]:
    """Shape of the numbers that the places share."""
    if per is Per.LEAF:
        return ()
    shapes = {_name(place, named): _part(named[place.leaf][1], place.index).shape for place in places}
    (first, shape), *others = shapes.items()
    count = 1 if per is Per.ROW else len(shape)
    for name, other in shapes.items():
        if not other:
            raise ValueError(f"{name} is one number, but its draw has {per}: leave per out")
    for name, other in others:
        if other[:count] != shape[:count] or (per is Per.ELEMENT and other != shape):
            raise ValueError(
                f"{first} has shape {shape} and {name} {other}: they cannot share a draw with {per}; draw them apart, "
                "or with Per.LEAF"
            )
    return shape[:count]


def _with_draw(leaf: Any, index: tuple[int | None, ...], numbers: Array, draw: Draw) -> Array:
    """The leaf with its part at the index drawn; the numbers belong to the part's first axes."""
    leaf = jnp.asarray(leaf)
    part = _part(leaf, index)
    numbers = numbers.reshape(numbers.shape + (1,) * (part.ndim - numbers.ndim)).astype(leaf.dtype)
    match draw:
        case Scale():
            new = part * numbers
        case Shift():
            new = part + numbers
        case _:
            new = jnp.broadcast_to(numbers, part.shape)
    return new if not index else leaf.at[_slices(index)].set(new)


def _part(leaf: Any, index: tuple[int | None, ...]) -> Array:
    return jnp.asarray(leaf)[_slices(index)]


def _slices(index: tuple[int | None, ...]) -> tuple[int | slice, ...]:
    return tuple(slice(None) if i is None else i for i in index)


def _name(place: _Place, named: list[tuple[Any, Any]]) -> str:
    """A place in words."""
    indices = "".join(f"[{_WHOLE if i is None else i}]" for i in place.index)
    return _dotted(named[place.leaf][0]) + indices


def _dotted(path: Any) -> str:
    """``scene.colliders[0].shape.radius``, ``model.parameters[body_mass]``."""
    return re.sub(r"\['(.*?)'\]", r"[\1]", jax.tree_util.keystr(path)).removeprefix(".")


def _parts(name: str) -> list[str]:
    return re.findall(r"[^.\[\]'\"]+", name)


__all__ = ["Draw", "LeafDraws", "hook", "leaves"]
