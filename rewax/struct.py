"""Frozen dataclasses that are JAX pytrees.

States and parameters of rewax are frozen, keyword-only dataclasses registered as pytrees. Their fields are leaves
(differentiated, vmapped, checkpointed), except for those marked ``static_field()``. Static fields are part of the
tree's structure: they are hashed and compared, and a change recompiles.

Constructors convert numbers (``Sphere(radius=0.1)``, ``gravity=(0, -9.81, 0)``) to JAX arrays, so that ``jax.grad``,
``jax.vmap`` and randomization find them. Absent values are ``None``.
"""

import dataclasses
import numbers
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey, register_pytree_with_keys

from rewax.short_repr import short_repr
from rewax.types import Scalar

T = TypeVar("T")


def field(*, pytree_node: bool = True, metadata: Mapping[str, Any] | None = None, **kwargs: Any) -> Any:
    """``dataclasses.field`` for a leaf, or for a static field with ``pytree_node=False``."""
    return dataclasses.field(metadata={**(metadata or {}), "pytree_node": pytree_node}, **kwargs)


def static_field(**kwargs: Any) -> Any:
    """A field that is part of the pytree's structure; its value must be hashable."""
    return field(pytree_node=False, **kwargs)


def number(
    legal: Any, remedy: str, *, shape: tuple[int | str, ...] | None = None, vector: bool = False, **kwargs: Any
) -> Any:
    """A field that holds a number or an array of numbers, with its legal values.

    ``rewax.physics.numerics.checks.numbers_of`` collects such fields of an object. Scenes check them when they are
    built, and inside compiled programs.

    Args:
      legal: a ``rewax.physics.numerics.checks.Legal``, for example ``POSITIVE``.
      remedy: advice in error messages, "give a length in metres".
      shape: required shape of the value, with a name for each axis of any length; None: any shape.
      vector: whether the value is one vector, shape (3,), or one per particle, shape (num_particles, 3).
      kwargs: arguments of ``dataclasses.field``, such as ``default``. A field with default None may be None.
    """
    return field(metadata={"number": (legal, remedy, shape), "vector": vector}, **kwargs)


class Structure(NamedTuple):
    """A tree's structure with the classes of its nodes, as a key.

    With jaxlib 0.10.1 the structures of two classes with equal field names compare equal if ``flax.struct.dataclass``
    or ``jax.tree_util.register_dataclass`` made them.
    """

    treedef: Any
    """The structure."""
    classes: tuple[type, ...]
    """Class of each node, parents first."""

    @classmethod
    def of(cls, treedef: Any) -> "Structure":
        return cls(treedef, tuple(_classes(treedef)))

    def unflatten(self, leaves: Iterable[Any]) -> Any:
        """The tree of these leaves."""
        return jax.tree.unflatten(self.treedef, leaves)


def _classes(treedef: Any) -> Iterator[type]:
    data = treedef.node_data()
    if data is not None:  # no leaf
        yield data[0]
        for child in treedef.children():
            yield from _classes(child)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field, static_field, number))
def dataclass(cls: type[T]) -> type[T]:
    """Decorator: a frozen, keyword-only dataclass that is a JAX pytree and has ``.replace(**changes)``.

    The constructor converts numbers, tuples and lists of numbers, and NumPy arrays of floats to JAX arrays. Tuples in
    fields of ``number`` may also hold JAX arrays of shape (), known or traced. A single number becomes weakly typed, so
    it does not promote other types. ``__post_init__`` runs in the constructor, but not when JAX rebuilds a tree.
    ``repr`` prints long arrays by type and shape.

    It does not use ``jax.tree_util.register_dataclass`` (nor flax's, which calls it): in jaxlib 0.10.1 the tree
    structures of two classes compare equal if their fields have the same names, and ``jit`` sometimes runs the program
    of a capsule for a cylinder.
    """
    _convert_first(cls)
    made: Any = dataclasses.dataclass(frozen=True, kw_only=True, repr=False)(cls)
    if made.__repr__ is object.__repr__:
        made.__repr__ = short_repr
    fields = dataclasses.fields(made)
    leaves = tuple(f.name for f in fields if f.metadata.get("pytree_node", True))
    static = tuple(f.name for f in fields if not f.metadata.get("pytree_node", True))
    keys = tuple(GetAttrKey(name) for name in leaves)

    def flatten(tree: Any) -> tuple[tuple, tuple]:
        return tuple(getattr(tree, name) for name in leaves), tuple(getattr(tree, name) for name in static)

    def flatten_with_keys(tree: Any) -> tuple[tuple, tuple]:
        children, values = flatten(tree)
        return tuple(zip(keys, children, strict=True)), values

    def unflatten(values: tuple, children: Any) -> Any:
        tree = object.__new__(made)
        vars(tree).update(zip(leaves, children, strict=True), **dict(zip(static, values, strict=True)))
        return tree

    register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    made.replace = dataclasses.replace
    return made


def _convert_first(cls: Any) -> None:
    """Makes ``__post_init__`` convert numbers to arrays first."""
    check = cls.__dict__.get("__post_init__")

    def __post_init__(self: Any) -> None:
        for each in dataclasses.fields(self):
            if each.metadata.get("pytree_node", True):
                value = getattr(self, each.name)
                is_real = "number" in each.metadata or each.type in (Scalar, Scalar | None)
                if (array := _as_leaf(value, is_real)) is not value:
                    object.__setattr__(self, each.name, array)
        if check is not None:
            check(self)
        elif (inherited := getattr(super(cls, self), "__post_init__", None)) is not None:
            inherited()

    cls.__post_init__ = __post_init__


def _as_leaf(value: Any, is_real: bool) -> Any:
    """Converts numbers to JAX arrays; tuples, and integers of real fields, become floats. Returns others unchanged."""
    if isinstance(value, (tuple, list)):
        if not value or not _all_numbers(value, with_arrays=is_real):
            return value
        try:
            if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
                array = jnp.asarray(value)
                return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)
            return _as_array(np.asarray(value, float))
        except ValueError:  # rows of several lengths: checks name the field
            return value
    if is_real and isinstance(value, (bool, np.bool_)):
        return value  # no real number: checks name the field
    if isinstance(value, numbers.Real) and not isinstance(value, np.generic):
        try:
            return jnp.asarray(float(value) if is_real else value)
        except OverflowError:
            return value
    if isinstance(value, (np.ndarray, np.generic)):
        if is_real and value.dtype.kind in "iu":
            value = value.astype(float)
        return _as_array(value) if value.dtype.kind == "f" else value
    if is_real and isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.integer):
        return value.astype(float)
    return value


def _as_array(value: np.ndarray | np.generic) -> jax.Array:
    """The array of JAX, rounded by NumPy and given with its dtype: otherwise JAX compiles a program for each shape."""
    dtype = jax.dtypes.canonicalize_dtype(value.dtype)
    return jnp.asarray(np.array(value, dtype), dtype)  # a copy, because JAX may share the memory


def _all_numbers(values: Any, *, with_arrays: bool) -> bool:
    """Whether nested tuples and lists hold numbers only, and with ``with_arrays`` real JAX arrays of shape ()."""

    def is_number(v: Any) -> bool:
        if isinstance(v, (tuple, list)):
            return len(v) > 0 and _all_numbers(v, with_arrays=with_arrays)
        if isinstance(v, jax.Array):
            real = jnp.issubdtype(v.dtype, jnp.floating) or jnp.issubdtype(v.dtype, jnp.integer)
            return with_arrays and v.ndim == 0 and real
        return isinstance(v, numbers.Real)

    return all(is_number(v) for v in values)


def replace_leaf(tree: Any, path: str, value: Any) -> Any:
    """A copy of nested objects with one parameter replaced.

    Args:
      tree: an environment, a scene, a material, ...
      path: names of fields, keys of dictionaries and indices of tuples, as ``rewax.envs.randomize.leaves`` lists them:
        ``"scene.material.elasticity.youngs_modulus"``, ``"scene.colliders[0].friction"``.
      value: the new number or array, of the old shape, or with one more axis in front (environments, particles); one
        number for all particles that had their own; None: the parameter is absent.

    Raises:
      ValueError: there is no such field (the message lists the existing fields), or the value has another shape or is
        no number.

    Gradient: exact with respect to ``value``.
    """
    return _replaced(tree, path, value, path)


def _replaced(tree: Any, path: str, value: Any, whole: str) -> Any:
    """``replace_leaf``; ``whole`` is the path from the outermost object, for messages."""
    name, rest = re.match(r"(\[[^\]]*\]|[^.\[]*)\.?(.*)", path).groups()  # type: ignore[union-attr]
    if name.startswith("["):
        key: Any = name[1:-1].strip("'\"")
        names = (
            tree if isinstance(tree, dict) else [str(i) for i in range(len(tree))] if isinstance(tree, tuple) else ()
        )
    else:
        key = name
        names = [f.name for f in dataclasses.fields(tree)] if dataclasses.is_dataclass(tree) else ()
    if key not in names:
        known = f"use one of {', '.join(names)}" if names else "it has none"
        raise ValueError(f"{type(tree).__name__} has no field {key!r}: {known}")
    if isinstance(tree, tuple):
        i = int(key)
        changed = _replaced(tree[i], rest, value, whole) if rest else _fitting(tree[i], value, whole)
        return type(tree)((*tree[:i], changed, *tree[i + 1 :]))
    old = tree[key] if isinstance(tree, dict) else getattr(tree, key)
    if rest:
        changed = _replaced(old, rest, value, whole)
    else:
        metadata = {} if isinstance(tree, dict) else {f.name: f.metadata for f in dataclasses.fields(tree)}[key]  # pyright: ignore[reportArgumentType]
        *_, required = metadata.get("number", ((),))
        changed = _fitting(old, value, whole, by_element=required is None and not metadata["vector"])
    return {**tree, key: changed} if isinstance(tree, dict) else dataclasses.replace(tree, **{key: changed})  # pyright: ignore[reportArgumentType]


def _fitting(old: Any, value: Any, path: str, *, by_element: bool = False) -> Any:
    """The value. Raises ValueError if the old one is a number or an array and the new one cannot take its place.

    With ``by_element`` a field holds one number, or one for each element.
    """
    shape = None if isinstance(old, (tuple, list, dict)) else _shape_of_numbers(old)
    if shape is None or value is None:  # None: the parameter is absent
        return value
    new = _shape_of_numbers(value)
    if new is None:
        raise ValueError(f"{path} is {value!r}: give a number or an array of shape {shape}")
    if new != shape and new[1:] != shape and not (by_element and new == shape[1:]):
        raise ValueError(f"{path} has shape {shape}, but the new value {new}: give numbers of shape {shape}")
    return value


def _shape_of_numbers(value: Any) -> tuple[int, ...] | None:
    """The shape of a number or an array of numbers; None for other values."""
    try:
        value = value if hasattr(value, "dtype") else np.asarray(value)
    except (ValueError, TypeError):  # rows of several lengths, traced numbers in a tuple
        return None
    is_number = jnp.issubdtype(value.dtype, jnp.number) or value.dtype == bool
    return tuple(value.shape) if is_number else None


class Replaceable:
    """Base class that declares the method ``replace``, which ``dataclass`` adds, for type checkers."""

    if TYPE_CHECKING:

        def replace(self, **changes: Any) -> Self:
            """A copy with some fields changed."""
            ...


__all__ = ["Replaceable", "Structure", "dataclass", "field", "number", "replace_leaf", "static_field"]
