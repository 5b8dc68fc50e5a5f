"""The system's compiler: what $CXX may say, and what it may do while it runs."""

import os
import shutil
import subprocess
import sys
import textwrap
import time

import pytest

from rewax.lowering import compiler

REAL = compiler.command()
needs_compiler = pytest.mark.skipif(REAL is None, reason="there is no C++ compiler")
needs_processes = pytest.mark.skipif(sys.platform == "win32", reason="scripts are run by a shell")


@pytest.fixture
def script(tmp_path, monkeypatch):
    """A program that stands in the compiler's place: ``script(text of a shell script)``."""

    def write(text, name="compiler"):
        path = tmp_path / name
        path.write_text("#!/bin/sh\n" + textwrap.dedent(text))
        path.chmod(0o755)
        monkeypatch.setenv("CXX", str(path))
        return path

    return write


@needs_compiler
@pytest.mark.parametrize(("before", "after"), [("env ", ""), ("", " -O1"), ("", ' -DTEXT="a b"'), ("  ", " ")])
def test_cxx_is_split_as_a_shell_does(monkeypatch, tmp_path, before, after):
    monkeypatch.setenv("CXX", f"{before}{REAL[0]}{after}")
    words = compiler.command()
    assert words is not None and shutil.which(words[0]) == words[0]
    assert compiler.build(words, "int one() { return 1; }", compiler.FLAGS, tmp_path)[:4]


@needs_processes
def test_a_path_with_a_space_is_one_word(script):
    path = script("", name="my compiler")
    assert compiler.command() == (str(path),)


@pytest.mark.parametrize("chosen", ["/nonexistent", "no_such_compiler -O1", '"', "/"])
def test_what_is_no_program_is_no_compiler(monkeypatch, chosen):
    monkeypatch.setenv("CXX", chosen)
    assert compiler.command() is None


@pytest.mark.parametrize("chosen", ["", "  "])
def test_an_empty_cxx_is_none(monkeypatch, chosen):
    monkeypatch.delenv("CXX", raising=False)
    found = compiler.command()
    monkeypatch.setenv("CXX", chosen)
    assert compiler.command() == found


@needs_processes
def test_output_that_is_not_utf_8(script, tmp_path):
    path = script(r"printf '\351\377 c++ \344\n'; printf 'fatal error: \377\n' >&2; test $1 = --version")
    assert "c++" in compiler.version((str(path),))
    with pytest.raises(compiler.CompilerError, match="failed \\(fatal error: "):
        compiler.build((str(path),), "", (), tmp_path)


@needs_processes
def test_the_line_with_the_error_is_the_one_that_is_named(script, tmp_path):
    path = script("echo 'In file included from x:' >&2; echo 'x:1: error: no' >&2; exit 1")
    with pytest.raises(compiler.CompilerError, match="failed \\(x:1: error: no\\)"):
        compiler.build((str(path),), "", (), tmp_path)


@needs_processes
@pytest.mark.parametrize("text", ["exit 0", "for file; do :; done; : > $file"])
def test_a_compiler_that_writes_nothing(script, tmp_path, text):
    path = script(text)
    with pytest.raises(compiler.CompilerError, match="it wrote no complete library"):
        compiler.build((str(path),), "", (), tmp_path)


@needs_compiler
@pytest.mark.parametrize("share", [0.0, 0.003, 0.5, 0.999])
def test_a_compiler_that_writes_half_a_library(script, tmp_path, share):
    """To load it would end the process."""
    whole = compiler.build(REAL, "int one() { return 1; }", compiler.FLAGS, tmp_path)
    part = tmp_path / "part"
    part.write_bytes(whole[: int(share * len(whole))])
    path = script(f"for file; do :; done; cp {part} $file")
    with pytest.raises(compiler.CompilerError, match="it wrote no complete library"):
        compiler.build((str(path),), "", (), tmp_path)


def is_running(pid):
    if not os.path.isdir(f"/proc/{pid}"):
        return False
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="there is no /proc")
@pytest.mark.parametrize("interrupted", [False, True])
def test_a_hanging_compiler_ends_with_all_that_it_started(script, tmp_path, monkeypatch, interrupted):
    path = script(f"sleep 1000 & echo $! > {tmp_path}/child; echo hangs; sleep 1000")
    if interrupted:

        def wait(self, timeout=None):
            if timeout is None:
                return real(self)
            time.sleep(1)
            raise KeyboardInterrupt

        real = subprocess.Popen.wait
        monkeypatch.setattr(subprocess.Popen, "wait", wait)
    begin = time.monotonic()
    with pytest.raises(
        KeyboardInterrupt if interrupted else compiler.CompilerError, match=None if interrupted else "1 s"
    ):
        compiler.run([str(path)], 1.0)
    assert time.monotonic() - begin < 30
    child = int((tmp_path / "child").read_text())
    for _ in range(50):  # a killed process is gone a moment later
        if not is_running(child):
            break
        time.sleep(0.1)
    assert not is_running(child)


@needs_processes
def test_a_server_that_the_compiler_leaves_is_not_waited_for(script):
    """ccache's like start one. It holds on to what they print to."""
    path = script("sleep 20 & echo done")
    begin = time.monotonic()
    assert compiler.run([str(path)], 60.0) == "done\n"
    assert time.monotonic() - begin < 15


@needs_processes
def test_a_full_disk_is_no_fault_of_the_program(script, tmp_path):
    """So that the caller builds in another folder."""
    script("echo 'error: cannot write: No space left on device' >&2; echo 'ld returned 1 exit status' >&2; exit 1")
    with pytest.raises(OSError, match="No space left on device"):
        compiler.build(compiler.command(), "", (), tmp_path)


@needs_processes
def test_a_compiler_that_reads_its_input_gets_none(script):
    assert compiler.run([str(script("cat; echo read"))], 60.0) == "read\n"


def test_a_program_that_does_not_run(tmp_path):
    path = tmp_path / "broken"
    path.write_bytes(b"\x7fELF nonsense")
    path.chmod(0o755)
    with pytest.raises(compiler.CompilerError, match="cannot be run"):
        compiler.run([str(path)], 60.0)


@pytest.mark.skipif(not os.path.exists("/proc/cpuinfo"), reason="there is no /proc/cpuinfo")
def test_flags_of_the_processor():
    flags = compiler.processor_flags()
    assert flags and list(flags) == sorted(flags) and not any(":" in flag for flag in flags)
    assert compiler.processor() == " ".join(flags)
