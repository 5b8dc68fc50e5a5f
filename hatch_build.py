"""Build hook: on Linux with a C++ compiler the wheel brings the libraries of the programs that never change.

Each program is built for three levels of x86-64; ``rewax.lowering.shipped`` chooses one. libstdc++ is linked into it,
so that it needs glibc only, of the version that the wheel's name says. Without a compiler, on other platforms and with
``REWAX_WHEEL_LEVELS=none`` in the environment, the wheel is pure and rewax builds the programs where it is used.
"""

import itertools
import os
import platform
import re
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# JAX refuses a library built with headers newer than its own, and takes older ones: the oldest that rewax works with.
_HEADERS = ["jax==0.10.1; python_version < '3.15'", "jax>=0.10.1; python_version >= '3.15'"]
_STATIC = ("-static-libstdc++", "-static-libgcc", "-Wl,--exclude-libs,ALL")
_SMALL = ("-Wl,--gc-sections", "-s")
_OLDEST_GLIBC = 17
"""2.17: no pip that knows manylinux tags of this form asks for less."""


class LibrariesHook(BuildHookInterface):
    """Puts shipped libraries into the wheel."""

    def dependencies(self) -> list[str]:
        """What is installed before a build; an editable one needs nothing."""
        editable = "get_requires_for_build_editable" in sys.argv
        return [] if editable or reason_for_none() else _HEADERS

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the libraries and name the platform; or say why not."""
        if version == "editable":
            return
        try:
            self.folder = tempfile.TemporaryDirectory(prefix="rewax-wheel-")
            files = build_libraries(Path(self.root), Path(self.folder.name))
        except NoLibrariesError as error:
            self.app.display_warning(f"This wheel brings no C++ libraries: {error}.")
            return
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform_tag(files)}"
        home = "rewax/lowering/shipped_libraries"
        build_data["force_include"] |= {
            str(file): f"{home}/{file.relative_to(self.folder.name).as_posix()}" for file in files
        }

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what the wheel holds by now."""
        if hasattr(self, "folder"):
            self.folder.cleanup()


class NoLibrariesError(Exception):
    """Why the wheel is pure."""


def reason_for_none() -> str | None:
    """Why no libraries are wanted here; None if they are."""
    if os.environ.get("REWAX_WHEEL_LEVELS") == "none":
        return "REWAX_WHEEL_LEVELS=none is set"
    if not sys.platform.startswith("linux") or platform.machine() != "x86_64":
        return "they are made for Linux on x86-64 only"
    return None


def build_libraries(root: Path, folder: Path) -> list[Path]:
    """Build every program for every level.

    ``REWAX_WHEEL_LEVELS`` may name the levels, separated by commas; unset: all.

    Args:
      root: where rewax is.
      folder: where the libraries go, each in the place that it has in ``shipped.FOLDER``.

    Raises:
      NoLibrariesError: there are none.
    """
    if reason := reason_for_none():
        raise NoLibrariesError(reason)
    sys.path.insert(0, str(root))
    try:
        import jax

        from rewax.fixed_sources import fixed_sources
        from rewax.lowering import compiler, library_cache, shipped
    except ImportError as error:
        raise NoLibrariesError(f"the headers of jax.ffi are missing ({error})") from error
    finally:
        sys.path.remove(str(root))
    words, include = compiler.command(), jax.ffi.include_dir()
    if words is None:
        raise NoLibrariesError("there is no C++ compiler")
    levels = os.environ.get("REWAX_WHEEL_LEVELS", ",".join(shipped.LEVELS)).split(",")
    if not set(levels) <= set(shipped.LEVELS):
        raise ValueError(f"REWAX_WHEEL_LEVELS={','.join(levels)}: choose of {', '.join(shipped.LEVELS)}, or none")
    major, minor = shipped.ffi_version(include) or (0, 0)

    def build(task: tuple[Any, str]) -> Path:
        source, level = task
        options = (*source.optimization, *compiler.FLAGS, f"-march={level}", "-I", include)
        for linking in ((*_STATIC, *_SMALL), _SMALL, ()):
            with tempfile.TemporaryDirectory(dir=folder) as empty:
                try:
                    contents = compiler.build(words, source.text, (*options, *linking), Path(empty))
                except compiler.CompilerError as error:
                    failure = error
                    continue
            home = folder / f"ffi-{major}.{minor}" / level
            home.mkdir(parents=True, exist_ok=True)
            return library_cache.keep(home, shipped.name(*source), contents)
        raise NoLibrariesError(str(failure))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(build, itertools.product(fixed_sources(), levels)))


def platform_tag(files: list[Path]) -> str:
    """Name of the oldest platform that libraries run on: manylinux with the newest glibc that one of them asks for."""
    contents = [file.read_bytes() for file in files]
    asked = [int(minor) for text in contents for minor in re.findall(rb"GLIBC_2\.(\d+)", text)]
    if not asked or any(b"libstdc++.so" in text for text in contents):
        return "linux_x86_64"
    return f"manylinux_2_{max(_OLDEST_GLIBC, *asked)}_x86_64"
