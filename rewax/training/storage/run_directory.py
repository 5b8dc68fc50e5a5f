"""Exclusive use of a run's directory by one process."""

import contextlib
import errno
import functools
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_FOLDERS = ("checkpoints", "tensorboard")
_FILES = ("config.json", "metrics.csv", "eval.csv", "timing.csv", "baselines.json")
_REMEDY = "choose another directory"


class InUse(ValueError):
    """Another process uses the directory."""


class CannotWrite(OSError):
    """The disk is full, or a file became too large; the message says what is kept."""


@contextlib.contextmanager
def full_disk_is_one_sentence(run_dir: Path, kept: Callable[[], str]) -> Iterator[None]:
    """Within the block, an exception that a full disk has caused, however deep, becomes ``CannotWrite``.

    Args:
      run_dir: directory of the run.
      kept: what is kept, as a part of a sentence.
    """
    try:
        yield
    except Exception as error:
        reason = _reason_of_full_disk(error)
        if not reason:
            raise
        raise CannotWrite(f"{run_dir} cannot be written to ({reason}): free some space; {kept()}") from None


def _reason_of_full_disk(error: BaseException | None) -> str:
    """The system's message about a full disk in a chain of exceptions; some libraries keep its text only."""
    codes = [getattr(errno, name) for name in ("ENOSPC", "EDQUOT", "EFBIG") if hasattr(errno, name)]
    while error is not None:
        for code in codes:
            if getattr(error, "errno", None) == code or os.strerror(code) in str(error):
                return os.strerror(code)
        error = error.__cause__ or error.__context__
    return ""


@contextlib.contextmanager
def hold(run_dir: Path, *, must_exist: bool = False) -> Iterator[Callable[[], None]]:
    """Within the block, this process alone uses the directory. The lock ends with the process, also if it is killed.

    After an exception in the block, the lock file and the folders that ``hold`` made are removed, unless something else
    has been written into them.

    Args:
      run_dir: made if missing.
      must_exist: do not make it.

    Yields:
      A function that removes what ``hold`` made, as after an exception; for a process that ends within the block.

    Raises:
      ValueError: in one sentence: the directory is missing, cannot be made or written to, or another process uses it
        (``InUse``).
    """
    if must_exist and not os.path.isdir(run_dir):
        raise ValueError(f"there is no run directory {run_dir}: check the path, or start a new run there")
    path = run_dir / ".lock"
    folders = [folder for folder in (run_dir, *run_dir.parents) if not os.path.lexists(folder)]
    clean = functools.partial(_remove_new, None if os.path.lexists(path) else path, folders)
    with _locked(run_dir):
        try:
            _check_contents(run_dir)
            yield clean
        except BaseException:
            clean()
            raise


def _locked(run_dir: Path) -> IO[str]:
    """The open and locked file; opened again if its former holder has removed the file in the meantime."""
    while True:
        lock = _open_lock(run_dir)
        try:
            _take(lock, run_dir)
            there = (run_dir / ".lock").stat()
            if os.path.samestat(there, os.fstat(lock.fileno())):
                return lock
        except FileNotFoundError:
            pass
        except BaseException:
            lock.close()
            raise
        lock.close()


def _remove_new(lock: Path | None, folders: Sequence[Path]) -> None:
    """Remove a lock file, and then those folders that are empty, the innermost first."""
    with contextlib.suppress(OSError):
        if lock is not None:
            lock.unlink()
        for folder in folders:
            folder.rmdir()


def _open_lock(run_dir: Path) -> IO[str]:
    if os.path.lexists(run_dir) and not os.path.isdir(run_dir):
        raise ValueError(f"run_dir is {run_dir}, which is not a directory: {_REMEDY}")
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        if not os.access(run_dir, os.W_OK | os.X_OK):
            raise PermissionError(0, "Permission denied")
        return (run_dir / ".lock").open("a+")
    except OSError as error:
        raise ValueError(f"run_dir is {run_dir}, which cannot be written to ({error.strerror}): {_REMEDY}") from None


def _check_contents(run_dir: Path) -> None:
    for path in (run_dir / name for name in _FOLDERS):
        if os.path.lexists(path) and not (path.is_dir() and os.access(path, os.W_OK | os.X_OK)):
            raise ValueError(f"{path} is not a directory that can be written to: remove it, or {_REMEDY}")
    for path in (run_dir / name for name in _FILES):
        if path.is_dir():
            raise ValueError(f"{path} is a directory where the run keeps a file: remove it, or {_REMEDY}")


def _take(lock: IO[str], run_dir: Path) -> None:
    """Lock the file and write the process and the machine into it."""
    if fcntl is None:
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.seek(0)
        holder = lock.read().strip() or "another process"
        raise InUse(f"{run_dir} is in use by {holder}: wait until it ends, stop it, or {_REMEDY}") from None
    except OSError:  # a file system without locks
        return
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {socket.gethostname()}\n")
    lock.flush()


__all__ = ["CannotWrite", "InUse", "full_disk_is_one_sentence", "hold"]
