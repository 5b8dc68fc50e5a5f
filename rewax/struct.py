"""The one import point of the pytree dataclass.

State and parameters of rewax are frozen, keyword-only dataclasses registered as pytrees: fields are leaves
(differentiated, vmapped, checkpointed) unless marked ``static_field()``, which makes them part of the tree's
structure (hashed and compared, a change recompiles).
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self, TypeVar, dataclass_transform

from jax.tree_util import GetAttrKey, register_pytree_with_keys

T = TypeVar("T")


def field(*, pytree_node: bool = True, metadata: Mapping[str, Any] | None = None, **kwargs: Any) -> Any:
    """``dataclasses.field`` of a leaf, or with ``pytree_node=False`` of a static field."""
    return dataclasses.field(metadata={**(metadata or {}), "pytree_node": pytree_node}, **kwargs)


def static_field(**kwargs: Any) -> Any:
    """A field that is part of the pytree's structure instead of being a leaf; its value must be hashable."""
    return field(pytree_node=False, **kwargs)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field, static_field))
def dataclass(cls: type[T]) -> type[T]:
    """Decorator: a frozen, keyword-only dataclass that is a JAX pytree and has ``.replace(**changes)``.

    Not ``jax.tree_util.register_dataclass`` (nor flax's, which calls it): with jaxlib 0.10.1 the tree structures of two
    classes compare equal if their fields have the same names, and ``jit`` now and then runs what it compiled for a
    capsule when it is given a cylinder.
    """
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
        return made(**dict(zip(leaves, children, strict=True)), **dict(zip(static, values, strict=True)))

    register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    made.replace = dataclasses.replace
    return made


class Replaceable:
    """Base that tells type checkers of the method which ``dataclass`` adds."""

    if TYPE_CHECKING:

        def replace(self, **changes: Any) -> Self:
            """A copy with some fields changed."""
            ...


__all__ = ["Replaceable", "dataclass", "field", "static_field"]
