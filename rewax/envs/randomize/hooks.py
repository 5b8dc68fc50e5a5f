"""The hook that draws parameters of an environment by name."""

import dataclasses
import difflib
import itertools
import re
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.envs.randomize.distributions import Distribution, Per, Scale, Shift, Turn
from rewax.physics.numerics.pose import product
from rewax.physics.numerics.rotations import quaternion_to_matrix
from rewax.types import Array, Key

Draw: TypeAlias = Distribution | Scale | Shift | Turn
"""A distribution draws the value itself, ``Scale`` a factor of the present value, ``Shift`` an addend, ``Turn`` a
rotation that a rotation matrix is multiplied by."""
_Names: TypeAlias = str | tuple[str, ...]
_ALL = "*"
_WHOLE = ":"


def hook(draws: Mapping[_Names, Draw]) -> "LeafDraws":
    """A hook for ``Randomized`` and for the ``randomize=`` of every agent.

    Args:
      draws: distributions by the names of parameters, which ``leaves`` lists: ``"scene.material.density"``,
        ``"model.parameters[body_mass]"``. A tuple of names shares each drawn number: one factor for stiffness and
        yield stress. ``*`` matches any part of a name, again with one number for all matches:
        ``"scene.colliders[*].friction"``. Indices after a name choose a part of the array: ``"scene.gravity[1]"``,
        ``"model.parameters[geom_friction][:,0]"``. With ``Per.ROW`` or ``Per.ELEMENT`` an array gets several numbers.

    Raises:
      ValueError: there are no draws, a name is no string, or a value is no distribution. The agent checks that the
        names exist when it is made, the hook when it is called.

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
            raise ValueError(
                f"{names!r} is no name of a parameter: give a string, or a tuple of strings that share a draw"
            )
        if not isinstance(draw, (Distribution, Scale, Shift, Turn)):
            raise ValueError(
                f"the draw of {', '.join(names)} is {draw!r}: give a distribution, Scale(...), Shift(...) or Turn(...)"
            )
        found.append((names, draw))
    return LeafDraws(tuple(found))


def leaves(env: Any) -> dict[str, Any]:
    """The parameters of an environment by name: its floating-point numbers and arrays, all of which can be drawn."""
    named = [(_dotted(path), leaf) for path, leaf in jax.tree.leaves_with_path(env)]
    return {name: leaf for name, leaf in named if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)}


@dataclasses.dataclass(frozen=True)
class LeafDraws:
    """A function ``(key, env) -> env`` that draws parameters; ``hook`` makes it. Equal ones share compiled programs.

    Attributes:
      draws: pairs of the names that share a draw, and the draw.
    """

    draws: tuple[tuple[tuple[str, ...], Draw], ...]

    def __call__(self, key: Key, env: Any) -> Any:
        """The environment with drawn parameters.

        The draw of an entry depends on the key and on its names, and not on the other entries.

        Args:
          key: determines all draws.
          env: one environment.

        Returns:
          An environment of the same structure, shapes and dtypes.

        Raises:
          ValueError: a name fits no parameter, a parameter cannot be drawn like this, or it is drawn twice.

        Gradient: exact with respect to the parameters of the environment, see ``Scale`` and ``Shift``; none with
          respect to the key.
        """
        named, treedef = jax.tree.flatten_with_path(env)
        values = [leaf for _, leaf in named]
        for (names, draw), parts in zip(self.draws, _drawn_parts(self, named, env), strict=True):
            by = draw if isinstance(draw, Distribution) else draw.by
            shape = (3,) if isinstance(draw, Turn) else _shape_of_draw(parts, named, by.per)
            entry_key = jax.random.fold_in(key, zlib.crc32(" ".join(names).encode()))
            numbers = by.sample(entry_key, shape, jnp.result_type(float))
            for part in parts:
                values[part.leaf] = _with_draw(values[part.leaf], part.index, numbers, draw)
        return jax.tree.unflatten(treedef, values)


def with_numbers(env: Any, draws: LeafDraws, numbers: Sequence[Array]) -> Any:
    """The environment in which each draw gave this number, for draws with one number each (``Per.LEAF``).

    Args:
      env: one environment.
      draws: of ``hook``.
      numbers: one of shape () for each draw.

    Raises:
      ValueError: a name fits no parameter, a parameter cannot be drawn like this, or it is drawn twice.

    Gradient: exact with respect to the numbers.
    """
    named, treedef = jax.tree.flatten_with_path(env)
    values = [leaf for _, leaf in named]
    for (_, draw), parts, number in zip(draws.draws, _drawn_parts(draws, named, env), numbers, strict=True):
        for part in parts:
            values[part.leaf] = _with_draw(values[part.leaf], part.index, jnp.asarray(number), draw)
    return jax.tree.unflatten(treedef, values)


class _Part(NamedTuple):
    """A parameter, or a part of its array."""

    leaf: int
    """Index of the array among the leaves of the environment."""
    index: tuple[int | None, ...]  # pyright: ignore[reportIncompatibleMethodOverride]
    """Indices of the first axes of the array; None stands for a whole axis."""


def _overlap(part: _Part, other: _Part) -> bool:
    """Whether two parts share a number."""
    pairs = zip(part.index, other.index, strict=False)
    return part.leaf == other.leaf and all(i is None or j is None or i == j for i, j in pairs)


def _drawn_parts(draws: LeafDraws, named: list[tuple[Any, Any]], env: Any) -> list[list["_Part"]]:
    """The parameters, or parts of them, that each draw changes.

    Raises:
      ValueError: a name fits no parameter, a parameter cannot be drawn like this, or it is drawn twice.
    """
    found, drawn = [], set()
    for names, draw in draws.draws:
        parts = [part for name in names for part in _parts_named(name, named, env)]
        for part in parts:
            if any(_overlap(part, other) for other in drawn):
                raise ValueError(f"{_name(part, named)} is drawn twice: give it one distribution")
            drawn.add(part)
        _check_leaves(parts, named, draw)
        found.append(parts)
    return found


def reached(names: Sequence[str], others: Sequence[str], env: Any) -> tuple[bool, bool]:
    """Whether parameters share numbers with others, and whether all their numbers are among the others'.

    Args:
      names, others: of parameters, or of parts of them.
      env: whose parameters they are.
    """
    named = jax.tree.leaves_with_path(env)
    parts, rest = ([part for name in each for part in _parts_named(name, named, env)] for each in (names, others))

    def within(part: _Part, other: _Part) -> bool:
        pairs = itertools.zip_longest(part.index, other.index)
        return part.leaf == other.leaf and all(j is None or i == j for i, j in pairs)

    some = any(_overlap(part, other) for part in parts for other in rest)
    return some, all(any(within(part, other) for other in rest) for part in parts)


def _parts_named(name: str, named: list[tuple[Any, Any]], env: Any) -> list[_Part]:
    """The parameters, or parts of them, that a name matches."""
    wanted = _parts(name)
    found = []
    for i, (path, leaf) in enumerate(named):
        own = _parts(_dotted(path))
        same = len(own) <= len(wanted) and all(a in (b, _ALL) for a, b in zip(wanted, own, strict=False))
        if same and own:
            found.append(_Part(i, _index(name, wanted[len(own) :], _dotted(path), jnp.shape(leaf))))
    if not found:
        raise ValueError(_no_leaf(name, named, env))
    return found


def _index(name: str, parts: list[str], leaf_name: str, shape: tuple[int, ...]) -> tuple[int | None, ...]:
    given = [part.strip() for text in parts for part in text.split(",")]
    if not all(part == _WHOLE or re.fullmatch(r"-?\d+", part) for part in given):
        raise ValueError(
            f"{name} continues after the parameter {leaf_name}: end there, or give indices as in {leaf_name}[0]"
        )
    index = tuple(None if part == _WHOLE else int(part) for part in given)
    inside = len(index) <= len(shape) and all(i is None or -n <= i < n for i, n in zip(index, shape, strict=False))
    if not inside:
        raise ValueError(
            f"{name} is no part of the parameter {leaf_name}, which has shape {shape}: give indices within it"
        )
    return tuple(None if i is None else i % n for i, n in zip(index, shape, strict=False))


def _no_leaf(name: str, named: list[tuple[Any, Any]], env: Any) -> str:
    """The error message for a wrong name, with known names that are similar as a whole or at their end."""
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
    return f"{kind} has no parameter {name!r}: {hint}rewax.envs.randomize.leaves(env) has all {num} by name"


def _check_leaves(parts: list[_Part], named: list[tuple[Any, Any]], draw: Draw) -> None:
    """Raises ValueError for parameters that this draw cannot change."""
    for part in parts:
        name, leaf = _name(part, named), named[part.leaf][1]
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            kind = jnp.result_type(leaf).name
            raise ValueError(f"{name} is of type {kind}: only floats can be drawn; give the environment a float there")
        if isinstance(draw, Scale) and _is_fixed(leaf, part.index):
            raise ValueError(f"{name} is {leaf}, which no factor changes: give its values, as in Uniform(0.1, 0.5)")
        if isinstance(draw, Turn) and (shape := _part(leaf, part.index).shape)[-2:] != (3, 3):
            raise ValueError(f"{name} has shape {shape}: Turn is for rotation matrices, of shape (3, 3)")


def _is_fixed(leaf: Any, index: tuple[int | None, ...]) -> bool:
    """Whether no factor changes this part, because it is zero or infinite. False for a traced array."""
    if isinstance(leaf, Tracer):
        return False
    part = np.asarray(leaf)[_slices(index)]
    return bool(np.all((part == 0.0) | np.isinf(part)))


def _shape_of_draw(parts: list[_Part], named: list[tuple[Any, Any]], per: Per) -> tuple[int, ...]:
    """Shape of the numbers that the parts share."""
    if per is Per.LEAF:
        return ()
    shapes = {_name(part, named): _part(named[part.leaf][1], part.index).shape for part in parts}
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
    """The array with the drawn part. ``numbers`` has the first axes of the part."""
    leaf = jnp.asarray(leaf)
    part = _part(leaf, index)
    numbers = numbers.astype(leaf.dtype)
    if not isinstance(draw, Turn):
        numbers = numbers.reshape(numbers.shape + (1,) * (part.ndim - numbers.ndim))
    match draw:
        case Turn():
            new = product(part, _rotation(numbers))
        case Scale():
            new = part * numbers
        case Shift():
            new = part + numbers
        case _:
            new = jnp.broadcast_to(numbers, part.shape)
    return new if not index else leaf.at[_slices(index)].set(new)


def _rotation(vector: Array) -> Array:
    """The rotation matrix of a rotation vector [rad], shapes (3,), (3, 3)."""
    half = 0.5 * jnp.linalg.norm(vector)
    return quaternion_to_matrix(jnp.append(jnp.cos(half), 0.5 * jnp.sinc(half / jnp.pi) * vector))


def _part(leaf: Any, index: tuple[int | None, ...]) -> Array:
    return jnp.asarray(leaf)[_slices(index)]


def _slices(index: tuple[int | None, ...]) -> tuple[int | slice, ...]:
    return tuple(slice(None) if i is None else i for i in index)


def _name(part: _Part, named: list[tuple[Any, Any]]) -> str:
    """The name of a part, with its indices."""
    indices = "".join(f"[{_WHOLE if i is None else i}]" for i in part.index)
    return _dotted(named[part.leaf][0]) + indices


def _dotted(path: Any) -> str:
    """``scene.colliders[0].shape.radius``, ``model.parameters[body_mass]``."""
    return re.sub(r"\['(.*?)'\]", r"[\1]", jax.tree_util.keystr(path)).removeprefix(".")


def _parts(name: str) -> list[str]:
    return re.findall(r"[^.\[\]'\"]+", name)


__all__ = ["Draw", "LeafDraws", "hook", "leaves", "with_numbers"]
