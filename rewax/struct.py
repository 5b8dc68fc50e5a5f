"""The one import point of the pytree dataclass.

State and parameters of rewax are frozen, keyword-only dataclasses registered as pytrees: fields are leaves
(differentiated, vmapped, checkpointed) unless marked ``static_field()``, which makes them part of the tree's
structure (hashed and compared, a change recompiles).

A number is a leaf. Numbers that a constructor gets (``Sphere(radius=0.1)``, ``gravity=(0, -9.81, 0)``) become JAX
arrays, so that ``jax.grad``, ``jax.vmap`` and randomization find them. What is absent is ``None``.
"""

import dataclasses
import numbers
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey, register_pytree_with_keys

from rewax.types import Scalar

T = TypeVar("T")


def field(*, pytree_node: bool = True, metadata: Mapping[str, Any] | None = None, **kwargs: Any) -> Any:
    """``dataclasses.field`` of a leaf, or with ``pytree_node=False`` of a static field."""
    return dataclasses.field(metadata={**(metadata or {}), "pytree_node": pytree_node}, **kwargs)


def static_field(**kwargs: Any) -> Any:
    """A field that is part of the pytree's structure instead of being a leaf; its value must be hashable."""
    return field(pytree_node=False, **kwargs)


def number(
    legal: Any, remedy: str, *, shape: tuple[int, ...] | None = None, vector: bool = False, **kwargs: Any
) -> Any:
    """A field that holds a number, or an array of them, with what it may be.

    ``rewax.physics.numerics.checks.numbers_of`` collects such fields of an object; scenes check them when they are
    built and inside compiled programs.

    Args:
      legal: a ``rewax.physics.numerics.checks.Legal``, ``POSITIVE`` for example.
      remedy: what messages advise, "give a length in metres".
      shape: the shape that the value must have; None: any.
      vector: the value is one vector, or one for each particle, of shape (3,) or (num_particles, 3).
      kwargs: ``default`` for example; a field whose default is None may be None.
    """
    return field(metadata={"number": (legal, remedy, shape), "vector": vector}, **kwargs)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field, static_field, number))
def dataclass(cls: type[T]) -> type[T]:
    """Decorator: a frozen, keyword-only dataclass that is a JAX pytree and has ``.replace(**changes)``.

    The constructor turns numbers, tuples and lists of numbers and NumPy arrays of floats into JAX arrays: one number
    is weakly typed, it does not widen what it is combined with. ``__post_init__`` runs in the constructor; a tree that
    JAX rebuilds is not checked again.

    Not ``jax.tree_util.register_dataclass`` (nor flax's, which calls it): with jaxlib 0.10.1 the tree structures of two
    classes compare equal if their fields have the same names, and ``jit`` now and then runs what it compiled for a
    capsule when it is given a cylinder.
    """
    _convert_first(cls)
    made: Any = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
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
    """Make ``__post_init__`` begin with numbers as arrays."""
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
    """Numbers as a JAX array, anything else as it is. Tuples, and the integers of a real field, become floats."""
    if isinstance(value, (tuple, list)):
        if not value or not _all_numbers(value):
            return value
        try:
            return jnp.asarray(np.asarray(value, float))
        except ValueError:  # rows of several lengths: checks name the field
            return value
    if isinstance(value, numbers.Real) and not isinstance(value, np.generic):
        return jnp.asarray(float(value) if is_real else value)
    if isinstance(value, (np.ndarray, np.generic)):
        if is_real and value.dtype.kind in "biu":
            value = value.astype(float)
        return jnp.asarray(value) if value.dtype.kind == "f" else value
    if is_real and isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.integer):
        return value.astype(float)
    return value


def _all_numbers(values: Any) -> bool:
    return all(
        isinstance(v, numbers.Real) or (isinstance(v, (tuple, list)) and len(v) > 0 and _all_numbers(v)) for v in values
    )


def replace_leaf(tree: Any, path: str, value: Any) -> Any:
    """A copy of nested objects in which one number is another.

    Args:
      tree: an environment, a scene, a material, ...
      path: names of fields, keys of dictionaries and indices of tuples, as ``rewax.envs.randomize.leaves`` lists them:
        ``"scene.material.elasticity.youngs_modulus"``, ``"scene.colliders[0].friction"``.
      value: the new number or array.

    Raises:
      ValueError: there is no such field. The message lists those that there are.

    Gradient: exact with respect to ``value``.
    """
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
        changed = replace_leaf(tree[i], rest, value) if rest else value
        return type(tree)((*tree[:i], changed, *tree[i + 1 :]))
    old = tree[key] if isinstance(tree, dict) else getattr(tree, key)
    changed = replace_leaf(old, rest, value) if rest else value
    return {**tree, key: changed} if isinstance(tree, dict) else dataclasses.replace(tree, **{key: changed})  # pyright: ignore[reportArgumentType]


class Replaceable:
    """Base that tells type checkers of the method which ``dataclass`` adds."""

    if TYPE_CHECKING:

        def replace(self, **changes: Any) -> Self:
            """A copy with some fields changed."""
            ...


__all__ = ["Replaceable", "dataclass", "field", "number", "replace_leaf", "static_field"]
