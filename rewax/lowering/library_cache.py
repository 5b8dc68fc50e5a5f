"""Cache of built libraries: verified before loading, written atomically, in a folder that only the user can write to.

A library's file is called ``<name>-<checksum>.so``. The checksum covers the name and every byte, because the dynamic
loader maps a truncated file without an error, and the process dies when it reads a missing page.
"""

import atexit
import contextlib
import ctypes
import hashlib
import os
import shutil
import stat
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

_LARGEST = 2**28
"""Largest size of a library in bytes."""
_LEFTOVER_S = 3600.0
"""Age in seconds at which a build folder belongs to a killed process: a build takes minutes at most."""
_BUILD, _TEMPORARY = "building-", "rewax-native-"
_temporary: list[Path] = []


def load(name: str, make: Callable[[Path], bytes]) -> tuple[ctypes.CDLL, Path]:
    """A library and its file: the cached one if it is undamaged, else a new one.

    Args:
      name: identifies the library; without a slash.
      make: builds the library in an empty folder and returns its bytes.

    Raises:
      OSError: the library cannot be written or loaded, not even in a temporary folder.
    """
    home = folder()
    path, damaged = find(home, name, private=True)
    if path:
        with contextlib.suppress(OSError):
            return ctypes.CDLL(str(path)), path
        _remove(path)  # it was built against other system libraries
    contents = None
    try:
        with _build_folder(home) as empty:
            contents = make(empty)
            path = keep(home, name, contents, empty)
        for other in damaged:
            if other != path and fault(other, name, private=True):
                _remove(other)
        return _loaded(path), path
    except OSError as error:  # the disk is full, read-only, or mounted noexec
        home = temporary_folder()
        with _build_folder(home) as empty:
            path = keep(home, name, contents or make(empty), empty)
        library = _loaded(path)
        warn(f"{name} cannot be kept and is built at every start ({error})")
        return library, path


def _loaded(path: Path) -> ctypes.CDLL:
    """Loads a new library, and removes it if that fails."""
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        _remove(path)
        raise


def find(home: Path, name: str, *, private: bool) -> tuple[Path | None, list[Path]]:
    """The undamaged library of a name, if any, and the damaged files of that name. Warns about the latter.

    Args:
      home: folder of the library.
      name: as in ``load``.
      private: whether to refuse files that others can write to.
    """
    damaged = []
    for path in sorted(home.glob(f"{name}[-.]*")):
        reason = fault(path, name, private=private)
        if reason is None:
            return path, damaged
        warn(f"{path} is not used: {reason}")
        damaged.append(path)
    return None, damaged


def fault(path: Path, name: str, *, private: bool) -> str | None:
    """Why a library must not be loaded; None if it is undamaged."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
    try:
        if path.is_symlink():
            return "it is a link"
        descriptor = os.open(path, flags)  # O_NONBLOCK: a pipe without a writer would block
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                return "it is no file"
            if private and (reason := _not_private(status)):
                return reason
            if status.st_size > _LARGEST:
                return "it is too large"
            contents = file.read()
    except OSError as error:
        return f"it cannot be read ({error.strerror})"
    return None if path.name == file_name(name, contents) else "it is damaged"


def file_name(name: str, contents: bytes) -> str:
    """Name of the file of a library."""
    return f"{name}-{hashlib.sha256(name.encode() + bytes(1) + contents).hexdigest()[:32]}.so"


def keep(home: Path, name: str, contents: bytes, empty: Path | None = None) -> Path:
    """Writes a library into a folder atomically, also if the machine crashes.

    An existing file is replaced, never written to, because another process may have mapped it.

    Args:
      home: the folder.
      name: as in ``load``.
      contents: bytes of the library.
      empty: a folder on the same disk for unfinished files; None: ``home``.
    """
    path = home / file_name(name, contents)
    descriptor, unfinished = tempfile.mkstemp(dir=empty or home, prefix=_BUILD)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(contents)
            file.flush()
            os.fsync(descriptor)
        if path.is_dir() and not path.is_symlink():
            _remove(path)
        os.replace(unfinished, path)
    except BaseException:
        Path(unfinished).unlink(missing_ok=True)
        raise
    with contextlib.suppress(OSError):  # some file systems, and Windows, cannot
        descriptor = os.open(home, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    return path


# --- Folders ----------------------------------------------------------------------------------------------------------


def folder() -> Path:
    """``$XDG_CACHE_HOME/rewax/native`` (``~/.cache/rewax/native``); a temporary folder if others can write there."""
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        return _made_private(cache.absolute() / "rewax" / "native")
    except (OSError, RuntimeError) as error:  # RuntimeError: no home
        warn(f"C++ is built at every start, in a temporary folder: {error}; XDG_CACHE_HOME can name another cache")
        return temporary_folder()


def temporary_folder() -> Path:
    """A folder that is removed when this process ends."""
    _temporary[:] = [path for path in _temporary if path.is_dir()]  # another program may have removed it
    if not _temporary:
        _remove_leftovers(Path(tempfile.gettempdir()), _TEMPORARY)
        path, owner = Path(tempfile.mkdtemp(prefix=f"{_TEMPORARY}{os.getpid()}-")), os.getpid()
        _temporary.append(path)
        atexit.register(lambda: os.getpid() == owner and shutil.rmtree(path, ignore_errors=True))
    return _temporary[0]


def _made_private(path: Path) -> Path:
    """Creates a folder, if needed, that belongs to the user and that nobody else can write to."""
    for part in (*reversed(path.parents), path):
        if not part.is_dir():
            part.mkdir(mode=0o700, exist_ok=True)
    for part, forbidden in ((path.parent, 0o022), (path, 0o077)):
        status = part.stat()
        if status.st_uid == _user(status) and status.st_mode & forbidden:
            part.chmod(stat.S_IMODE(status.st_mode) & ~forbidden)
        reason = _not_private(part.stat())
        if reason and not (part == path.parent and status.st_uid == 0 and not status.st_mode & forbidden):
            raise PermissionError(f"{part} is not used: {reason}")
    return path


def _not_private(status: os.stat_result) -> str | None:
    if status.st_uid != _user(status):
        return "it belongs to another user"
    return "others can write to it" if os.name == "posix" and status.st_mode & 0o022 else None


def _user(status: os.stat_result) -> int:
    return os.geteuid() if hasattr(os, "geteuid") else status.st_uid


@contextlib.contextmanager
def _build_folder(home: Path) -> Iterator[Path]:
    _remove_leftovers(home, _BUILD)
    with tempfile.TemporaryDirectory(dir=home, prefix=_BUILD, ignore_cleanup_errors=True) as empty:
        yield Path(empty)


def _remove_leftovers(home: Path, prefix: str) -> None:
    """Removes files of killed processes from a folder."""
    for path in home.glob(f"{prefix}*"):
        with contextlib.suppress(OSError):
            status = path.lstat()
            old = time.time() - status.st_mtime > _LEFTOVER_S and status.st_uid == _user(status)
            if old and not (prefix == _TEMPORARY and _is_running(path.name[len(prefix) :].split("-")[0])):
                _remove(path)


def _is_running(pid: str) -> bool:
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except (OSError, ValueError):
        pass
    return True


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def warn(sentence: str) -> None:
    """Warns the user, once per process."""
    warnings.warn(sentence, stacklevel=3)
