"""Objects that are compared by their content, as static fields and arguments have to be."""

from collections.abc import Hashable
from typing import Any


class ByContent:
    """An object that ``content`` determines: equal contents mean equal objects, in this process and in a later one.

    Hashable, so that it can be a static field. Subclasses call this constructor.
    """

    def __init__(self, *content: Hashable) -> None:
        self.content = content
        self._hash = hash(content)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: Any) -> bool:
        return self is other or (
            type(self) is type(other) and self._hash == other._hash and self.content == other.content
        )


__all__ = ["ByContent"]
