"""Progress messages of a check."""

import time
from collections.abc import Callable


class Progress:
    """Passes lines with the name of the check and the elapsed time [s] to ``notify``, unless that is None."""

    def __init__(self, what: str, notify: Callable[[str], None] | None) -> None:
        self._what, self._notify, self._began = what, notify, time.perf_counter()

    def __call__(self, line: str) -> None:
        if self._notify is not None:
            self._notify(f"{self._what}, {time.perf_counter() - self._began:.0f} s: {line}")


__all__ = ["Progress"]
