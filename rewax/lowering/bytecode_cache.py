"""Cache of assembled bytecode on disk, beside JAX's cache of compiled programs.

To differentiate a traced function and to assemble its bytecode takes longer than to trace it. With JAX's persistent
compilation cache switched on, bytecode is kept in the folder ``rewax-bytecode`` inside it. A file's name is a hash of
all that the bytecode depends on: the function's jaxpr, the rules of differentiation that it holds with their sources,
the rule, the types, the sources of this package, and versions of JAX, NumPy and MuJoCo. A jaxpr that holds something
whose content cannot be hashed exactly is not cached.
"""

import contextlib
import dataclasses
import enum
import functools
import hashlib
import io
import json
import os
import re
import time
import types
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import linear_util
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from rewax.lowering.assembler import BlockBytecode
from rewax.lowering.by_content import ByContent
from rewax.lowering.lane_assembler import Bytecode
from rewax.lowering.operations import UnsupportedError
from rewax.whole_files import replacing

_LARGEST = 2**28
"""Largest size of all files in bytes. The first file that a process writes removes the oldest ones beyond it."""
_KINDS: dict[str, type] = {"Bytecode": Bytecode, "BlockBytecode": BlockBytecode}
_TRUSTED = ("rewax.", "jax.", "jaxlib.", "numpy.", "builtins.", "functools.", "inspect.")
"""Modules whose functions are known by their name: the key holds their version, or their sources."""
_IMPORT = re.compile(r"^\s*(?:from|import)\s+(rewax(?:\.[\w.]+)?)(?:\s+import\s+(\([^)]*\)|[^\n]*))?", re.MULTILINE)
_IMPORTED = time.time()
"""A source that is edited later is not that of the code that runs."""
_PLAIN = frozenset([bool, int, float, complex, str, bytes])


def remembered(key: str | None, make: Callable[[], Any]) -> Any:
    """The value of an earlier process for this key, else that of ``make``, which is kept.

    Args:
      key: from ``key_of``; None: nothing is read or written.
      make: returns nested tuples of bytecode, NumPy types, numbers and strings.

    Raises:
      UnsupportedError: raised by ``make``, now or in an earlier process.
    """
    home = folder() if key else None
    if home is None:
        return make()
    path = home / f"{key}.npz"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, EOFError):  # no file, or a damaged one
        kept = _decoded(path.read_bytes())
        if isinstance(kept, UnsupportedError):
            raise kept
        return kept
    try:
        value = make()
    except UnsupportedError as error:
        _keep(path, error)
        raise
    _keep(path, value)
    return value


def folder() -> Path | None:
    """The folder of the bytecode; None if JAX's cache is off or not on a disk of this machine."""
    home = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if not home or "://" in home or not jax.config.jax_enable_compilation_cache:  # pyright: ignore[reportAttributeAccessIssue]
        return None
    return Path(home) / "rewax-bytecode"


def key_of(traced: ClosedJaxpr, *rest: Any) -> str | None:
    """Name of a program's bytecode; None if something that it depends on cannot be hashed exactly.

    Args:
      traced: the function, before differentiation.
      rest: everything else that the bytecode depends on.
    """
    if folder() is None:
        return None
    hasher = _Hasher()
    flags = [getattr(jax.config, name, None) for name in ("jax_enable_x64", "jax_default_matmul_precision")]
    try:
        return hasher.digest((sources("rewax.lowering"), _versions(), flags, traced, rest))
    except _UnknownError:
        return None


@functools.cache
def _versions() -> tuple[str, ...]:
    """Versions of the packages that rules of differentiation call."""
    return tuple(metadata.version(name) for name in ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx"))


@functools.cache
def sources(module: str) -> str:
    """Hash of the sources of a module of rewax, of those that it imports, and so on; of all modules of a package.

    Raises:
      _UnknownError: a source was edited or replaced after this process has imported it.
    """
    found: dict[str, bytes] = {}
    rest = [module]
    while rest:
        name = rest.pop()
        path = _file_of(name)
        if name in found or path is None:
            continue
        found[name] = path.read_bytes()
        written = path.stat()
        if max(written.st_mtime, written.st_ctime) > _IMPORTED:  # a copy may keep the time of the original
            raise _UnknownError(name)
        rest += _imports(found[name])
        if name == module and path.stem == "__init__":
            rest += [f"{name}.{inner.stem}" for inner in path.parent.glob("*.py")]
    digest = hashlib.sha256()
    for name in sorted(found):
        digest.update(f"{name}\0{len(found[name])}\0".encode() + found[name])
    return digest.hexdigest()


@functools.lru_cache(maxsize=1024)
def _imports(source: bytes) -> list[str]:
    """Names that a source imports, at the top or inside functions, if they may be modules of rewax."""
    names = []
    for module, imported in _IMPORT.findall(source.decode()):
        inside = [f"{module}.{name}" for name in re.findall(r"\w+", imported)]
        names += inside if module == "rewax" and all(map(_file_of, inside)) else [module, *inside]
    return names


def _file_of(module: str) -> Path | None:
    """The source of a module of rewax; None for other names."""
    path = Path(__file__).resolve().parents[2].joinpath(*module.split("."))
    return next((file for file in (path / "__init__.py", path.with_suffix(".py")) if file.is_file()), None)


# --- Keys -------------------------------------------------------------------------------------------------------------


class _UnknownError(Exception):
    """A value whose content cannot be hashed."""


class _Hasher:
    """Hashes values by content: equal hashes mean equal values. Raises for values that it does not know."""

    def __init__(self) -> None:
        self.known: dict[int, tuple[Any, str]] = {}
        """Hashes of jaxprs by identity; they occur many times. Holds the jaxprs, so that identities stay unique."""
        self.open: list[int] = []
        """Functions being hashed: one that refers to itself is hashed by its place in this list."""

    def digest(self, value: Any) -> str:
        lines: list[str] = []
        self.write(value, lines.append)
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()

    def write(self, value: Any, line: Callable[[str], None]) -> None:
        """Writes lines that no other value has, nor the beginning of another value's."""
        kind = type(value)
        if value is None or kind in _PLAIN:
            line(f"{kind.__name__} {value!r}")
        elif kind is tuple or kind is list:
            line(f"{kind.__name__} {len(value)}")
            for part in value:
                self.write(part, line)
        elif isinstance(value, (ClosedJaxpr, Jaxpr)):
            line(f"jaxpr {self.jaxpr(value)}")
        elif isinstance(value, (np.ndarray, np.generic, jax.Array)):
            self.array(value, line)
        elif isinstance(value, jax.tree_util.PyTreeDef):
            line("tree")
            node = value.node_data()
            self.write((node, value.children()) if node else value.num_leaves, line)
        elif isinstance(value, np.dtype):
            line(f"dtype {value.str} {value!r}")
        elif isinstance(value, enum.Enum):
            line(f"enum {self.named(kind)} {value.name}")
        elif isinstance(value, (tuple, list)):
            line(f"named {self.named(kind)}")
            self.write(tuple(value), line)
        elif isinstance(value, (dict, types.MappingProxyType)):
            line(f"mapping {len(value)}")
            for pair in sorted(self.digest(pair) for pair in value.items()):
                line(pair)
        elif isinstance(value, (set, frozenset)):
            line(f"set {len(value)}")
            for part in sorted(map(self.digest, value)):
                line(part)
        elif isinstance(value, type):
            line(f"type {self.named(value)}")
        elif isinstance(value, linear_util.WrappedFun):
            line("wrapped")
            self.write((value.f, value.transforms, value.params), line)
        elif isinstance(value, functools.partial):
            line("partial")
            self.write((value.func, value.args, value.keywords), line)
        elif isinstance(value, types.MethodType):
            line("method")
            self.write((value.__func__, value.__self__), line)
        elif isinstance(value, (types.FunctionType, types.BuiltinFunctionType)):
            self.function(value, line)
        elif is_trusted(kind):
            self.instance(value, line)
        else:
            raise _UnknownError(kind)

    def jaxpr(self, value: ClosedJaxpr | Jaxpr) -> str:
        if id(value) in self.known:
            return self.known[id(value)][1]
        jaxpr, consts = (value.jaxpr, value.consts) if isinstance(value, ClosedJaxpr) else (value, ())
        numbers: dict[Any, int] = {}
        lines: list[str] = []

        def add(text: str, variables: Any) -> None:
            parts = [text]
            for v in variables:
                if isinstance(v, Literal):
                    parts.append(f"{np.asarray(v.val).tolist()!r} {_type(v.aval)}")
                else:
                    parts.append(f"{numbers.setdefault(v, len(numbers))} {_type(v.aval)}")
            lines.append("; ".join(parts))

        self.write(tuple(consts), lines.append)
        add("constants", jaxpr.constvars)
        add("arguments", jaxpr.invars)
        for eqn in jaxpr.eqns:
            add(eqn.primitive.name, eqn.invars)
            for name in sorted(eqn.params):
                if name not in ("debug_info", "name"):
                    lines.append(name)
                    self.write(eqn.params[name], lines.append)
            add("to", eqn.outvars)
        add("results", jaxpr.outvars)
        found = hashlib.sha256("\n".join(lines).encode()).hexdigest()
        self.known[id(value)] = value, found
        return found

    def array(self, value: Any, line: Callable[[str], None]) -> None:
        if isinstance(value, Tracer) or jnp.issubdtype(value.dtype, jax.dtypes.extended):
            raise _UnknownError(type(value))
        numbers = np.asarray(value)
        if numbers.dtype.hasobject:
            raise _UnknownError(numbers.dtype)
        weak = getattr(value, "weak_type", False)
        line(f"array {numbers.dtype} {numbers.shape} {weak} {hashlib.sha256(numbers.tobytes()).hexdigest()}")

    def function(self, value: Any, line: Callable[[str], None]) -> None:
        if id(value) in self.open:
            line(f"again {self.open.index(id(value))}")
            return
        line(f"function {self.named(value)}")
        if not isinstance(value, types.FunctionType):
            return
        self.open.append(id(value))
        try:
            cells = zip(value.__code__.co_freevars, value.__closure__ or (), strict=True)
            inside = {name: cell.cell_contents for name, cell in cells}
        except ValueError as error:  # an empty cell
            raise _UnknownError(value) from error
        if value.__qualname__ == "_memoize.<locals>.memoized":  # JAX's memory of the results of another function
            inside = inside["fn"]
        self.write((value.__code__.co_firstlineno, value.__defaults__, value.__kwdefaults__, inside), line)
        self.open.pop()

    def instance(self, value: Any, line: Callable[[str], None]) -> None:
        """Writes an object of a class of JAX, NumPy or this package."""
        kind = type(value)
        line(f"instance {self.named(kind)}")
        if kind.__name__ in ("Store", "EqualStore"):
            return  # where JAX's transformations leave the structure of results
        if isinstance(value, ByContent):
            inside: Any = value.content
        elif isinstance(value, (jax.custom_jvp, jax.custom_vjp)) or kind.__name__ == "Unhashable":
            inside = vars(value) if hasattr(value, "__dict__") else value.val
        elif dataclasses.is_dataclass(value):
            inside = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        elif kind.__module__.startswith("rewax."):
            raise _UnknownError(kind)  # what it prints, or the function that it wraps, may not say all
        elif hasattr(value, "__wrapped__"):  # a jitted function
            inside = value.__wrapped__
        else:
            inside = repr(value)
            if any(mark in inside for mark in (" at 0x", "...")):
                raise _UnknownError(kind)  # it may not say all
        self.write(inside, line)

    def named(self, value: Any) -> str:
        if not is_trusted(value):
            raise _UnknownError(value)
        module = value.__module__
        version = sources(module) if module.startswith("rewax.") else ""
        return f"{module}.{value.__qualname__} {version}"


def is_trusted(value: Any) -> bool:
    """Whether a function or class is known by its name."""
    return f"{getattr(value, '__module__', None)}.".startswith(_TRUSTED)


def _type(aval: Any) -> str:
    shape, dtype = getattr(aval, "shape", None), getattr(aval, "dtype", None)
    if shape is None or dtype is None or not all(isinstance(size, int) for size in shape):
        raise _UnknownError(aval)
    return f"{dtype}{shape}{getattr(aval, 'weak_type', False)}"


# --- Files ------------------------------------------------------------------------------------------------------------


def _encoded(value: Any) -> bytes:
    arrays: list[np.ndarray] = []

    def plain(value: Any) -> Any:
        if isinstance(value, UnsupportedError):
            return {"unsupported": str(value)}
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return {"array": len(arrays) - 1}
        if isinstance(value, np.dtype):
            return {"dtype": value.name}
        if isinstance(value, tuple):
            name = type(value).__name__
            return {name if name in _KINDS else "tuple": [plain(part) for part in value]}
        if value is None or type(value) in (bool, int, str):
            return value
        raise TypeError(f"bytecode does not consist of {type(value).__name__}")

    text = json.dumps(plain(value))
    file = io.BytesIO()
    named: Any = {f"a{k}": a for k, a in enumerate(arrays)}
    np.savez_compressed(file, text=np.array(text), **named)
    contents = file.getvalue()
    return hashlib.sha256(contents).digest() + contents


def _decoded(contents: bytes) -> Any:
    if hashlib.sha256(contents[32:]).digest() != contents[:32]:
        raise ValueError("it is damaged")
    with np.load(io.BytesIO(contents[32:]), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}

    def value(found: Any) -> Any:
        if not isinstance(found, dict):
            return found
        ((kind, inside),) = found.items()
        if kind == "unsupported":
            return UnsupportedError(inside)
        if kind == "array":
            return arrays[f"a{inside}"]
        if kind == "dtype":
            return np.dtype(inside)
        parts = tuple(value(part) for part in inside)
        return parts if kind == "tuple" else _KINDS[kind](*parts)

    return value(json.loads(str(arrays["text"])))


def _keep(path: Path, value: Any) -> None:
    """Writes a file atomically. A disk that is full or cannot be written to is no error."""
    with contextlib.suppress(OSError), replacing(path) as unfinished:
        _remove_oldest(path.parent)
        unfinished.write_bytes(_encoded(value))


@functools.cache
def _remove_oldest(home: Path) -> None:
    """Removes the oldest files, once per process, until those that are left take half of the largest size."""
    files = []
    for entry in os.scandir(home):
        with contextlib.suppress(OSError):
            status = entry.stat()
            files.append((status.st_mtime, status.st_size, entry.path))
    total = sum(size for _, size, _ in files)
    if total <= _LARGEST:
        return
    for _, size, path in sorted(files):
        if total <= _LARGEST // 2:
            break
        with contextlib.suppress(OSError):
            os.unlink(path)
            total -= size


__all__ = ["folder", "key_of", "remembered", "sources"]
