"""The system's C++ compiler: which it is, and how it is run."""

import functools
import os
import platform
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

_COMPILERS = ("c++", "g++", "clang++")
FLAGS = ("-std=c++17", "-fno-math-errno", "-fwrapv", "-fno-trapping-math", "-fPIC", "-shared", "-w")
NATIVE = {"x86_64": ("-march=native",), "AMD64": ("-march=native",)}
"""Options for the instructions of this processor, by the name of its architecture."""
_BUILD_S, _VERSION_S = 300.0, 60.0
_MOST_OUTPUT = 2**20


class CompilerError(Exception):
    """A sentence about a compiler that made nothing."""


def command() -> tuple[str, ...] | None:
    """The compiler and options that come with it: ``$CXX``, split as a shell does, else c++, g++ or clang++.

    None without one.
    """
    chosen = os.environ.get("CXX", "").strip()
    if chosen:
        whole = shutil.which(chosen)  # a path may hold spaces
        try:
            words = [chosen] if whole else shlex.split(chosen)
        except ValueError:  # a quotation mark too few
            return None
        program = whole or (shutil.which(words[0]) if words else None)
        return (program, *words[1:]) if program else None
    if sys.platform == "win32":
        return None
    program = next(filter(None, map(shutil.which, _COMPILERS)), None)
    return (program,) if program else None


@functools.cache
def version(words: tuple[str, ...]) -> str:
    """What the compiler says of itself.

    Raises:
      CompilerError: nothing.
    """
    return run([*words, "--version"], _VERSION_S)


def build(words: Sequence[str], text: str, options: Sequence[str], folder: Path) -> bytes:
    """The shared library of a C++ program.

    Args:
      words: the compiler.
      text: the program.
      options: of the compiler, ``FLAGS`` among them.
      folder: where files may be left.

    Raises:
      CompilerError: there is none.
    """
    program, library = folder / "program.cc", folder / "library.so"
    program.write_text(text, encoding="utf-8")
    run([*words, *options, str(program), "-o", str(library)], _BUILD_S)
    contents = library.read_bytes() if library.is_file() else b""
    if not contents or _is_cut(contents):
        raise CompilerError(f"{shlex.join(words)} failed (it wrote no whole library)")
    return contents


def _is_cut(contents: bytes) -> bool:
    """Whether a library of Linux lacks its end, where linkers write the table of sections: to load it is to crash."""
    if contents[:6] != b"\x7fELF\x02\x01":  # 64 bits, little-endian
        return False
    begin, size, number = struct.unpack("<40xQ10xHH2x", contents[:64].ljust(64))
    return len(contents) < max(64, begin + size * number)


def run(words: Sequence[str], seconds: float) -> str:
    """What a program prints. It and the programs that it starts end with the time limit, or with this call.

    Raises:
      CompilerError: it failed.
    """
    name = shlex.join(words[: -1 if len(words) == 2 else 1])
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        try:
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=output,  # files: a pipe stays open as long as anything that the compiler starts
                stderr=errors,
                env={**os.environ, "LC_ALL": "C"},
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            raise CompilerError(f"{name} cannot be run ({error})") from error
        try:
            status = process.wait(seconds)
        except subprocess.TimeoutExpired as error:
            _kill(process)
            raise CompilerError(f"{name} took longer than {seconds:.0f} s") from error
        except BaseException:
            _kill(process)
            raise
        if status:
            said = _text(errors).strip().splitlines()
            first = next((line for line in said if "error" in line), said[0] if said else f"exit status {status}")
            raise CompilerError(f"{name} failed ({first})")
        return _text(output)


def _text(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read(_MOST_OUTPUT).decode("utf-8", "replace")


def _kill(process: subprocess.Popen) -> None:
    """A program and all that it started: they are a group of processes of their own."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (AttributeError, OSError):  # Windows has no groups
        process.kill()
    process.wait()


def processor() -> str:
    """What tells processors with different instructions apart: a cache may be shared between machines."""
    return " ".join(processor_flags()) or platform.processor()


@functools.cache
def processor_flags() -> tuple[str, ...]:
    """Names that Linux gives to a processor's instructions, none elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ()
    found = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return tuple(sorted(set(found.partition(":")[2].split())))
