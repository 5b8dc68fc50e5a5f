"""Lines about what a check is doing."""

import time
from collections.abc import Callable


class Progress:
    """Says what is under way, and after how many seconds; nothing where ``notify`` is None."""

    def __init__(self, what: str, notify: Callable[[str], None] | None) -> None:
        self._what, self._notify, self._began = what, notify, time.perf_counter()

    def __call__(self, line: str) -> None:
        if self._notify is not None:
            self._notify(f"{self._what}, {time.perf_counter() - self._began:.0f} s: {line}")


__all__ = ["Progress"]
