"""C++ that XLA calls on a CPU: built where it is used, by the compiler that is there, once.

A wheel stays free of binaries, and the code is that of the machine's own instructions. Without a compiler, or with
``REWAX_NATIVE=0`` in the environment, ``load`` gives None and callers do without: whatever is written in C++ is written
with JAX, too.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import jax

from rewax.lowering.portability import is_portable

THREADS = Path(__file__).with_name("threads.h")
"""Text to begin a program with that shares its work out among threads."""

_COMPILERS = ("c++", "g++", "clang++")
_FLAGS = ("-std=c++17", "-fno-math-errno", "-fwrapv", "-fno-trapping-math", "-fPIC", "-shared", "-w")
_NATIVE = {"x86_64": "-march=native", "AMD64": "-march=native"}
_SECONDS = 300


class Source(NamedTuple):
    """A C++ program."""

    stem: str
    """Beginning of its library's name."""
    text: str
    optimization: tuple[str, ...] = ("-O3",)
    """Options of the compiler."""


class Loaded(NamedTuple):
    """A library, or why there is none."""

    library: ctypes.CDLL | None
    reason: str
    """Where the library is, or a sentence about what is missing."""


@functools.cache
def register(source: Source, symbols: tuple[str, ...]) -> bool:
    """Make functions of a C++ program known to XLA as targets of ``jax.ffi.ffi_call`` on a CPU.

    Args:
      source: the program; it may include the headers of ``jax.ffi``.
      symbols: names of its handlers, which are the targets' names, too.

    Returns:
      Whether they can be called.
    """
    library = load(source).library
    if library is None:
        return False
    for symbol in symbols:
        jax.ffi.register_ffi_target(symbol, jax.ffi.pycapsule(getattr(library, symbol)), platform="cpu")
    return True


@functools.cache
def load(source: Source) -> Loaded:
    """The library of a C++ program, built if this machine has not built it before.

    Libraries are kept in ``$XDG_CACHE_HOME/rewax/native`` (``~/.cache/rewax/native``), one for each version of the
    source, the compiler, jaxlib and the processor. The compiler is ``$CXX``, else the first of c++, g++ and clang++.
    """
    if is_off():
        return Loaded(None, "REWAX_NATIVE=0 is set")
    chosen = compiler()
    if chosen is None:
        return Loaded(None, "there is no C++ compiler")
    flags = [*source.optimization, *_FLAGS, *filter(None, [_NATIVE.get(platform.machine())])]
    try:
        version = _version(chosen)
        parts = (source.text, version, *flags, metadata.version("jaxlib"), platform.machine(), _processor())
        name = f"{source.stem}-{hashlib.sha256('|'.join(parts).encode()).hexdigest()[:16]}.so"
        path = _folder() / name
        if not path.is_file():
            with tempfile.TemporaryDirectory(dir=path.parent) as folder:  # others may build it at the same time
                unfinished, text = Path(folder) / name, Path(folder) / f"{source.stem}.cc"
                text.write_text(source.text)
                _output([chosen, *flags, "-I", jax.ffi.include_dir(), str(text), "-o", str(unfinished)])
                unfinished.replace(path)
        return Loaded(ctypes.CDLL(str(path)), str(path))
    except subprocess.CalledProcessError as error:
        said = (error.stderr or "").strip().splitlines()
        return Loaded(None, f"{chosen} failed ({said[0] if said else f'exit status {error.returncode}'})")
    except (OSError, subprocess.TimeoutExpired) as error:
        return Loaded(None, f"it could not be built or loaded ({error})")


def is_off() -> bool:
    """Whether programs hold no C++: the user wants none, or they must run elsewhere."""
    return os.environ.get("REWAX_NATIVE") == "0" or is_portable()


def compiler() -> str | None:
    """Path of the C++ compiler that is used, None without one."""
    if os.environ.get("CXX"):
        return shutil.which(os.environ["CXX"])
    if sys.platform == "win32":
        return None
    return next(filter(None, map(shutil.which, _COMPILERS)), None)


@functools.cache
def _version(path: str) -> str:
    return _output([path, "--version"])


def _output(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=_SECONDS)
    return done.stdout


def _processor() -> str:
    """What tells processors with different instructions apart: a cache may be shared between machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())


def _folder() -> Path:
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rewax" / "native"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder):
            return folder
    except OSError:
        return _temporary_folder()


@functools.cache
def _temporary_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="rewax-native-"))
