"""The one import point of the pytree dataclass.

State and parameters of rewax are frozen, keyword-only dataclasses registered as pytrees: fields are leaves
(differentiated, vmapped, checkpointed) unless marked ``static_field()``, which makes them part of the tree's
structure (hashed and compared, a change recompiles).
"""

from typing import TYPE_CHECKING, Any, Self, TypeVar, dataclass_transform

import flax.struct
from flax.struct import field

T = TypeVar("T")


def static_field(**kwargs: Any) -> Any:
    """A field that is part of the pytree's structure instead of being a leaf; its value must be hashable."""
    return field(pytree_node=False, **kwargs)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field, static_field))
def dataclass(cls: type[T]) -> type[T]:
    """Decorator: a frozen, keyword-only dataclass that is a JAX pytree and has ``.replace(**changes)``."""
    return flax.struct.dataclass(cls, kw_only=True)


class Replaceable:
    """Base that tells type checkers of the method which ``dataclass`` adds."""

    if TYPE_CHECKING:

        def replace(self, **changes: Any) -> Self:
            """A copy with some fields changed."""
            ...


__all__ = ["Replaceable", "dataclass", "field", "static_field"]
