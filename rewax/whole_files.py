"""Files that are replaced in one step, so that a reader sees the old file or the new one, never a part."""

import contextlib
import secrets
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Gives a path beside ``path`` to write to; at the end of the block that file becomes ``path``.

    If the block raises, the unfinished file is removed and ``path`` stays as it was. Each call has its own unfinished
    file, so processes may write the same file side by side: the last one wins. Missing folders are made.

    Args:
      path: the file. The unfinished one has the same suffix, because some programs choose a format by it.

    Raises:
      OSError: the file cannot be replaced.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".writing-{secrets.token_hex(4)}-{path.name}")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        with contextlib.suppress(OSError):  # a read-only disk: the first exception says so
            unfinished.unlink(missing_ok=True)


def check_can_write(path: str | Path) -> None:
    """Raises OSError if a file cannot be written there: before a long computation, not after it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    probe = path.with_name(f".writing-{secrets.token_hex(4)}-{path.name}")
    probe.touch()
    probe.unlink()


__all__ = ["check_can_write", "replacing"]
