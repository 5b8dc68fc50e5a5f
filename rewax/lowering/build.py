"""Loads C++ FFI targets: shipped libraries, cached ones, or ones that the system compiler builds.

``load`` prefers a library of the wheel (``shipped``), then one that this machine built before (``library_cache``), then
builds it (``compiler``). If all fail, or with ``REWAX_NATIVE=0`` in the environment, ``load`` returns None and callers
use JAX: every C++ program has an equivalent in JAX.
"""

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import threading
import warnings
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import jax

from rewax.lowering import compiler as compilers
from rewax.lowering import library_cache, report, shipped
from rewax.lowering.portability import is_portable

THREADS = Path(__file__).with_name("threads.h")
"""Header to prepend to programs that distribute work over threads."""

_refused: set["Source"] = set()
"""Programs whose shipped library this JAX refuses."""

_loaded: dict["Source", "Loaded"] = {}
"""What ``load`` returned."""

_locks: dict["Source", threading.Lock] = {}
if hasattr(os, "register_at_fork"):  # a lock that another thread holds would never be released in the child
    os.register_at_fork(after_in_child=_locks.clear)


class Source(NamedTuple):
    """A C++ program."""

    stem: str
    """Prefix of the library's file name."""
    text: str
    optimization: tuple[str, ...] = ("-O3",)
    """Options of the compiler."""


class Loaded(NamedTuple):
    """A library, or the reason why there is none."""

    library: ctypes.CDLL | None
    reason: str
    """Path of the library, or a sentence that says what is missing."""


@functools.cache
def register(source: Source, symbols: tuple[str, ...]) -> bool:
    """Registers functions of a C++ program as targets of ``jax.ffi.ffi_call`` on a CPU.

    Callers of other functions of the library must call ``load`` afterwards, because a shipped library that this JAX
    refuses is replaced by a built one.

    Args:
      source: the program; it may include the headers of ``jax.ffi``.
      symbols: names of its handlers, which are also the targets' names.

    Returns:
      Whether the targets can be called.
    """
    library, reason = load(source)
    if library is None:
        return False
    version = shipped.ffi_version_of(Path(reason))
    if version not in (None, shipped.ffi_version(jax.ffi.include_dir())):
        with contextlib.suppress(RuntimeError):  # there is no CPU
            jax.local_devices(backend="cpu")  # create the backend first: else a refused library breaks it
    try:
        for symbol in symbols:
            jax.ffi.register_ffi_target(symbol, jax.ffi.pycapsule(getattr(library, symbol)), platform="cpu")
    except Exception:  # its type differs between releases of JAX
        if version is None:
            raise
        _refused.add(source)
        _loaded.pop(source, None)
        return register.__wrapped__(source, symbols)
    return True


def is_usable(source: Source, symbols: tuple[str, ...], name: str) -> bool:
    """Whether C++ is on and ``register`` succeeds; if only that fails, the module ``name`` is reported as in XLA."""
    if is_off():
        return False
    registered = register(source, symbols)
    if not registered:
        report.note(name, "value", load(source).reason)
    return registered


def load(source: Source) -> Loaded:
    """The library of a C++ program: shipped, cached, or built now.

    Libraries are cached in ``$XDG_CACHE_HOME/rewax/native`` (``~/.cache/rewax/native``), one for each source, compiler,
    jaxlib and processor. The compiler is ``$CXX``, else the first of c++, g++ and clang++. With ``REWAX_NATIVE=build``
    in the environment, shipped libraries are not used. Threads that load the same program build it once.
    """
    if source not in _loaded:
        with _locks.setdefault(source, threading.Lock()):
            if source not in _loaded:
                _loaded[source] = _load(source)
    return _loaded[source]


def _load(source: Source) -> Loaded:
    if _is_unwanted():
        return Loaded(None, "REWAX_NATIVE=0 is set")
    path = shipped.find(*source) if _may_be_shipped() and source not in _refused else None
    if path:
        try:
            return Loaded(ctypes.CDLL(str(path)), str(path))
        except OSError as error:
            library_cache.warn(f"{path} is not used: {error}")
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
    """Whether programs must hold no C++: by the user's choice, or because they must be portable."""
    return _is_unwanted() or is_portable()


def _is_unwanted() -> bool:
    return os.environ.get("REWAX_NATIVE") == "0"


def compiler() -> str | None:
    """The C++ compiler with the options of $CXX; None without a compiler."""
    words = compilers.command()
    return shlex.join(words) if words else None


def no_compiler() -> str:
    """A sentence that says that there is no compiler."""
    chosen = os.environ.get("CXX")
    return f"there is no C++ compiler (CXX={chosen})" if chosen else "there is no C++ compiler"


def is_available() -> bool:
    """Whether C++ is wanted, and there is a compiler or libraries that came with rewax. Else warns once on a CPU.

    A compiler may fail all the same: ``machine.why_in_xla`` tries it.
    """
    if is_off():
        return False
    found = compiler() is not None or (_may_be_shipped() and bool(shipped.folders()))
    if not found and jax.default_backend() == "cpu":
        _warn_of_none()
    return found


@functools.cache
def _warn_of_none() -> None:
    """Warns once per process that everything runs in XLA."""
    warnings.warn(
        f"physics runs in XLA, 2 to 8 times slower than in C++: {no_compiler()}; install g++ or clang++, or set CXX",
        report.LoweringWarning,
        stacklevel=3,
    )


def _may_be_shipped() -> bool:
    return os.environ.get("REWAX_NATIVE") != "build"
