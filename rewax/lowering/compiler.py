"""Finds and runs the system's C++ compiler."""

import errno
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
"""Options that enable the instructions of this processor, by architecture."""
_BUILD_S, _VERSION_S = 300.0, 60.0
_MOST_OUTPUT = 2**20


class CompilerError(Exception):
    """The compiler failed. The message is a sentence that names the reason."""


def command() -> tuple[str, ...] | None:
    """The compiler and its options: ``$CXX``, split as a shell does, else c++, g++ or clang++; None without one."""
    chosen = os.environ.get("CXX", "").strip()
    if chosen:
        path = shutil.which(chosen)  # a path may hold spaces
        try:
            words = [chosen] if path else shlex.split(chosen)
        except ValueError:  # an unclosed quotation mark
            return None
        program = path or (shutil.which(words[0]) if words else None)
        return (program, *words[1:]) if program else None
    if sys.platform == "win32":
        return None
    program = next(filter(None, map(shutil.which, _COMPILERS)), None)
    return (program,) if program else None


@functools.cache
def version(words: tuple[str, ...]) -> str:
    """Output of the compiler's ``--version``.

    Raises:
      CompilerError: the compiler failed.
    """
    return run([*words, "--version"], _VERSION_S)


def build(words: Sequence[str], text: str, options: Sequence[str], folder: Path) -> bytes:
    """The shared library of a C++ program.

    Args:
      words: command of the compiler.
      text: source of the program.
      options: options of the compiler, including ``FLAGS``.
      folder: folder for temporary files.

    Raises:
      CompilerError: the compiler wrote no library.
      OSError: the disk is full.
    """
    program, library = folder / "program.cc", folder / "library.so"
    program.write_text(text, encoding="utf-8")
    run([*words, *options, str(program), "-o", str(library)], _BUILD_S)
    contents = library.read_bytes() if library.is_file() else b""
    if not contents or _is_cut(contents):
        raise CompilerError(f"{shlex.join(words)} failed (it wrote no complete library)")
    return contents


def _is_cut(contents: bytes) -> bool:
    """Whether an ELF library is truncated before the end of its section table; loading it would crash."""
    if contents[:6] != b"\x7fELF\x02\x01":  # 64 bits, little-endian
        return False
    begin, size, number = struct.unpack("<40xQ10xHH2x", contents[:64].ljust(64))
    return len(contents) < max(64, begin + size * number)


def run(words: Sequence[str], seconds: float) -> str:
    """Standard output of a program. The program and its children are killed at the time limit.

    Raises:
      CompilerError: the program failed.
      OSError: the disk is full.
    """
    name = shlex.join(words[: -1 if len(words) == 2 else 1])
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        try:
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=output,  # a file: a pipe would stay open as long as any child process
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
            messages = _text(errors).strip().splitlines()
            if any(os.strerror(errno.ENOSPC) in line for line in messages):
                raise OSError(errno.ENOSPC, f"{name} failed ({os.strerror(errno.ENOSPC)})")
            first = next(
                (line for line in messages if "error" in line), messages[0] if messages else f"exit status {status}"
            )
            raise CompilerError(f"{name} failed ({first})")
        return _text(output)


def _text(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read(_MOST_OUTPUT).decode("utf-8", "replace")


def _kill(process: subprocess.Popen) -> None:
    """Kills a program and its children, which form a process group."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (AttributeError, OSError):  # Windows has no groups
        process.kill()
    process.wait()


def processor() -> str:
    """A name of the processor's instruction set, because machines may share a cache."""
    return " ".join(processor_flags()) or platform.processor()


@functools.cache
def processor_flags() -> tuple[str, ...]:
    """Flags of the processor in Linux's /proc/cpuinfo; empty on other systems."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ()
    found = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return tuple(sorted(set(found.partition(":")[2].split())))
