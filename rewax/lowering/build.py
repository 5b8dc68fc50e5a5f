"""Compiles C++ FFI targets with the system compiler and caches them, where rewax brings no library for them.

``load`` prefers a library that came with the wheel (``shipped``), then one that this machine built before
(``library_cache``), then builds it (``compiler``). Without any of these, or with ``REWAX_NATIVE=0`` in the environment,
``load`` gives None and callers do without: whatever is written in C++ is written with JAX, too.
"""

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import threading
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import jax

from rewax.lowering import compiler as compilers
from rewax.lowering import library_cache, shipped
from rewax.lowering.portability import is_portable

THREADS = Path(__file__).with_name("threads.h")
"""Text to begin a program with that shares its work out among threads."""

_refused: set["Source"] = set()
"""Programs whose shipped library this JAX does not take."""

_locks: dict["Source", threading.Lock] = {}


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

    Whoever calls other functions of the library, too, calls ``load`` afterwards: a shipped library that this JAX
    refuses is replaced by one that is built.

    Args:
      source: the program; it may include the headers of ``jax.ffi``.
      symbols: names of its handlers, which are the targets' names, too.

    Returns:
      Whether they can be called.
    """
    library, reason = load(source)
    if library is None:
        return False
    version = shipped.ffi_version_of(Path(reason))
    if version not in (None, shipped.ffi_version(jax.ffi.include_dir())):
        with contextlib.suppress(RuntimeError):  # there is no CPU
            jax.local_devices(backend="cpu")  # refused before its backend exists, a library makes that fail, not this
    try:
        for symbol in symbols:
            jax.ffi.register_ffi_target(symbol, jax.ffi.pycapsule(getattr(library, symbol)), platform="cpu")
    except Exception:  # of several types in different releases of JAX
        if version is None:
            raise
        _refused.add(source)
        load.cache_clear()
        return register.__wrapped__(source, symbols)
    return True


@functools.cache
def load(source: Source) -> Loaded:
    """The library of a C++ program, built if it neither came with rewax nor was built by this machine before.

    Libraries are kept in ``$XDG_CACHE_HOME/rewax/native`` (``~/.cache/rewax/native``), one for each version of the
    source, the compiler, jaxlib and the processor. The compiler is ``$CXX``, else the first of c++, g++ and clang++.
    With ``REWAX_NATIVE=build`` in the environment, libraries that came with rewax are not used. Threads that ask for
    the same program build it once.
    """
    with _locks.setdefault(source, threading.Lock()):
        return _load(source)


def _load(source: Source) -> Loaded:
    if _is_unwanted():
        return Loaded(None, "REWAX_NATIVE=0 is set")
    path = shipped.find(*source) if _may_be_shipped() and source not in _refused else None
    if path:
        try:
            return Loaded(ctypes.CDLL(str(path)), str(path))
        except OSError as error:
            library_cache.say(f"{path} is not used: {error}")
    words = compilers.command()
    if words is None:
        return Loaded(None, no_compiler())
    try:
        options = [*source.optimization, *compilers.FLAGS, *compilers.NATIVE.get(platform.machine(), ())]
        jaxlib = metadata.version("jaxlib")
        parts = (source.text, compilers.version(words), *words, *options, jaxlib, platform.machine())
        key = hashlib.sha256("|".join((*parts, compilers.processor())).encode()).hexdigest()[:16]
        options += ["-I", jax.ffi.include_dir()]
        make = functools.partial(compilers.build, words, source.text, options)
        library, path = library_cache.load(f"{source.stem}-{key}", make)
        return Loaded(library, str(path))
    except compilers.CompilerError as error:
        return Loaded(None, str(error))
    except OSError as error:
        return Loaded(None, f"it could not be built or loaded ({error})")


def is_off() -> bool:
    """Whether programs hold no C++: the user wants none, or they must run elsewhere."""
    return _is_unwanted() or is_portable()


def _is_unwanted() -> bool:
    return os.environ.get("REWAX_NATIVE") == "0"


def compiler() -> str | None:
    """The C++ compiler that is used, with options that $CXX names, None without one."""
    words = compilers.command()
    return shlex.join(words) if words else None


def no_compiler() -> str:
    """A sentence for users who have no compiler."""
    chosen = os.environ.get("CXX")
    return f"there is no C++ compiler (CXX={chosen})" if chosen else "there is no C++ compiler"


def is_available() -> bool:
    """Whether programs that never change (``rewax.fixed_sources``) can run as C++: shipped or built."""
    return not is_off() and (compiler() is not None or (_may_be_shipped() and bool(shipped.folders())))


def _may_be_shipped() -> bool:
    return os.environ.get("REWAX_NATIVE") != "build"
