"""Libraries that come with rewax, for machines without a compiler: a wheel for Linux on x86-64 holds them.

``hatch_build.py`` builds them when it makes the wheel, a set for each level of instructions. Their names hold a hash of
their source, so that a library never stands for another text than its own.
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
"""Levels of x86-64, best first, and the flags by which /proc/cpuinfo shows one beyond those of the lower levels."""


def find(stem: str, text: str, options: tuple[str, ...]) -> Path | None:
    """The shipped library of a program that is best for this processor, None without one."""
    for folder in folders():
        path, _ = library_cache.find(folder, name(stem, text, options), private=False)
        if path:
            return path
    return None


def name(stem: str, text: str, options: tuple[str, ...]) -> str:
    """Beginning of a library's file name."""
    return f"{stem}-{hashlib.sha256('|'.join((text, *options)).encode()).hexdigest()[:16]}"


def folders() -> list[Path]:
    """Where shipped libraries are that this processor and this JAX can use, best first."""
    if not FOLDER.is_dir() or not sys.platform.startswith("linux") or platform.machine() != "x86_64":
        return []
    runtime = ffi_version(jax.ffi.include_dir())
    if runtime is None:  # what the runtime refuses may break JAX for a CPU altogether
        return []
    versions = [(ffi_version_of(home), home) for home in FOLDER.glob("ffi-*")]
    homes = [(version, home) for version, home in versions if version and (runtime[0], 0) <= version <= runtime]
    levels = processor_levels(compiler.processor_flags())
    return [home / level for _, home in sorted(homes, reverse=True) for level in levels if (home / level).is_dir()]


def processor_levels(flags: tuple[str, ...]) -> list[str]:
    """Levels that a processor has, best first.

    Args:
      flags: as /proc/cpuinfo names them.
    """
    found = []
    for level in reversed(LEVELS):
        if not set(LEVELS[level].split()) <= set(flags):
            break
        found.insert(0, level)
    return found


@functools.cache
def ffi_version(include: str) -> tuple[int, int] | None:
    """Version of XLA's foreign function interface: JAX refuses a library built with a newer one, or one of years ago.

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
    """The version of the headers that a shipped library was built with, None for any other file.

    Args:
      path: of the library, or of the folder of its version.
    """
    inside = path.relative_to(FOLDER).parts[:1] if path.is_relative_to(FOLDER) else ()
    found = re.fullmatch(r"ffi-(\d+)\.(\d+)", "".join(inside))
    return (int(found[1]), int(found[2])) if found else None
