"""Libraries in the wheel for Linux on x86-64, for machines without a compiler.

``hatch_build.py`` builds them with the wheel, one set for each level of x86-64. File names hold a hash of the source,
so that a library is only used for its own source.
"""

import functools
import hashlib
import platform
import re
import sys
from pathlib import Path

import jax

from rewax.lowering import compiler, library_cache

FOLDER = Path(__file__).with_name("shipped_libraries")

LEVELS = {
    "x86-64-v4": "avx512f avx512bw avx512cd avx512dq avx512vl",
    "x86-64-v3": "abm avx avx2 bmi1 bmi2 f16c fma movbe xsave",
    "x86-64-v2": "cx16 lahf_lm popcnt pni sse4_1 sse4_2 ssse3",
}
"""Levels of x86-64, best first, and the flags of /proc/cpuinfo that each adds to the level below."""


def find(stem: str, text: str, options: tuple[str, ...]) -> Path | None:
    """The best shipped library of a program for this processor; None without one."""
    for folder in folders():
        path, _ = library_cache.find(folder, name(stem, text, options), private=False)
        if path:
            return path
    return None


def name(stem: str, text: str, options: tuple[str, ...]) -> str:
    """Prefix of a library's file name."""
    return f"{stem}-{hashlib.sha256('|'.join((text, *options)).encode()).hexdigest()[:16]}"


def folders() -> list[Path]:
    """Folders of shipped libraries that this processor and this JAX can use, best first."""
    if not FOLDER.is_dir() or not sys.platform.startswith("linux") or platform.machine() != "x86_64":
        return []
    runtime = ffi_version(jax.ffi.include_dir())
    if runtime is None:  # a library that the runtime refuses may break JAX's CPU backend
        return []
    versions = [(ffi_version_of(home), home) for home in FOLDER.glob("ffi-*")]
    homes = [(version, home) for version, home in versions if version and (runtime[0], 0) <= version <= runtime]
    levels = processor_levels(compiler.processor_flags())
    return [home / level for _, home in sorted(homes, reverse=True) for level in levels if (home / level).is_dir()]


def processor_levels(flags: tuple[str, ...]) -> list[str]:
    """Levels of x86-64 that a processor supports, best first.

    Args:
      flags: the processor's flags in /proc/cpuinfo.
    """
    found = []
    for level in reversed(LEVELS):
        if not set(LEVELS[level].split()) <= set(flags):
            break
        found.insert(0, level)
    return found


@functools.cache
def ffi_version(include: str) -> tuple[int, int] | None:
    """Version of XLA's foreign function interface (FFI). JAX refuses libraries of a newer or a much older version.

    Args:
      include: folder of the headers of ``jax.ffi``.
    """
    try:
        text = (Path(include) / "xla" / "ffi" / "api" / "c_api.h").read_text()
    except OSError:
        return None
    found = [re.search(rf"#define XLA_FFI_API_{part} (\d+)", text) for part in ("MAJOR", "MINOR")]
    return (int(found[0][1]), int(found[1][1])) if found[0] and found[1] else None


def ffi_version_of(path: Path) -> tuple[int, int] | None:
    """FFI version of the headers that a shipped library was built with; None for any other file.

    Args:
      path: path of the library, or of the folder of its version.
    """
    inside = path.relative_to(FOLDER).parts[:1] if path.is_relative_to(FOLDER) else ()
    found = re.fullmatch(r"ffi-(\d+)\.(\d+)", "".join(inside))
    return (int(found[1]), int(found[2])) if found else None
