"""C++ for CPUs: built once, kept, and done without where it cannot be built."""

import os
import shutil
import stat
import subprocess
import sys
import threading
from pathlib import Path

import jax
import pytest

from rewax.lowering import build
from rewax.lowering.report import LoweringWarning
from rewax.physics.mpm import transfer_cpp

EMPTY = 'extern "C" int one() { return 1; }\n'
needs_compiler = pytest.mark.skipif(build.compiler() is None, reason="there is no C++ compiler")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("REWAX_NATIVE", raising=False)
    build._loaded.clear()
    build.register.cache_clear()
    yield tmp_path
    build._loaded.clear()
    build.register.cache_clear()


def written(text=EMPTY):
    return build.Source("one", text)


@needs_compiler
def test_is_built_once_for_each_version_of_the_source(folder):
    source = written()
    first = build.load(source)
    assert first.library.one() == 1
    (built,) = (folder / "cache" / "rewax" / "native").glob("*")
    assert str(built) == first.reason
    when = built.stat().st_mtime_ns
    build._loaded.clear()
    assert build.load(source).reason == first.reason and built.stat().st_mtime_ns == when
    build._loaded.clear()
    assert build.load(written(EMPTY.replace("1", "2"))).library.one() == 2


@needs_compiler
def test_a_cache_that_cannot_be_written_does_not_matter(folder, monkeypatch):
    (folder / "cache").write_text("a file")
    with pytest.warns(UserWarning, match="built at every start, in a temporary folder: .*File exists"):
        assert build.load(written()).library.one() == 1


@needs_compiler
def test_code_that_does_not_compile_gives_the_compilers_sentence(folder):
    found = build.load(written("not C++"))
    assert found.library is None and "failed (" in found.reason and "error" in found.reason
    assert not build.register(written("not C++"), ("one",))


def test_without_a_compiler(folder, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.delenv("CXX", raising=False)
    assert build.load(written()) == (None, "there is no C++ compiler")
    assert not transfer_cpp.is_used()


def test_can_be_turned_off(folder, monkeypatch):
    monkeypatch.setenv("REWAX_NATIVE", "0")
    assert build.load(written()) == (None, "REWAX_NATIVE=0 is set")


def load_in_a_process(folder, **environment):
    """What another process prints that loads the library, and its exit code."""
    program = f"from rewax.lowering import build\nprint(build.load(build.Source('one', {EMPTY!r})).library.one())"
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), **environment}
    environment["PYTHONPATH"] = str(Path(build.__file__).parents[2])
    environment.pop("REWAX_NATIVE", None)
    environment = {name: value for name, value in environment.items() if value is not None}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    return done.stdout, done.returncode, done.stderr


@needs_compiler
@pytest.mark.parametrize("size", [0, 1000, 5000])
def test_a_truncated_library_is_built_again(folder, size):
    assert load_in_a_process(folder)[:2] == ("1\n", 0)
    (path,) = (folder / "cache" / "rewax" / "native").glob("*")
    os.truncate(path, size)  # not mapped by this process, which would crash
    out, code, errors = load_in_a_process(folder)
    assert (out, code) == ("1\n", 0), errors
    assert errors.count("Warning: ") == 1 and "is not used: it is damaged" in errors
    assert load_in_a_process(folder) == ("1\n", 0, "")


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="root can give files away")
def test_a_library_of_another_user_is_not_loaded(folder):
    path = Path(build.load(written()).reason)
    os.chown(path, 54321, 54321)
    out, code, errors = load_in_a_process(folder)
    assert (out, code) == ("1\n", 0) and "is not used: it belongs to another user" in errors
    (kept,) = path.parent.glob("*.so")
    assert kept.stat().st_uid == os.geteuid()


@needs_compiler
def test_the_cache_is_the_users_own_whatever_the_umask(folder):
    before = os.umask(0)
    try:
        path = Path(build.load(written()).reason)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700 and not path.stat().st_mode & 0o022


@needs_compiler
@pytest.mark.parametrize("options", [" -O1", " -DX='a b'"])
def test_cxx_may_hold_options(folder, monkeypatch, options):
    monkeypatch.setenv("CXX", build.compiler() + options)
    build._loaded.clear()
    library, reason = build.load(written())
    assert library is not None and library.one() == 1, reason


@pytest.mark.skipif(sys.platform == "win32", reason="a script stands in the compiler's place")
def test_a_compiler_that_prints_another_encoding(folder, monkeypatch):
    path = folder / "compiler"
    path.write_text("#!/bin/sh\nprintf 'erreur g\\351n\\351rale: error\\n' | tee /dev/stderr\ntest $1 = --version\n")
    path.chmod(0o755)
    monkeypatch.setenv("CXX", str(path))
    found = build.load(written())
    assert found.library is None and f"{path} failed (erreur g" in found.reason


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "setuid") or os.geteuid() != 0, reason="root can become a user without a name")
def test_a_user_without_a_name_and_a_home(folder, tmp_path):
    """As in containers that run under any number."""
    if not all(folder.stat().st_mode & 0o001 for folder in Path(jax.__file__).resolve().parents):
        pytest.skip("the virtual environment is its owner's alone")
    program = (
        "import os, sys\nfrom rewax.lowering import build\nos.setuid(54321)\n"
        f"print(build.load(build.Source('one', {EMPTY!r})).library.one())"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("HOME", "XDG_CACHE_HOME")}
    environment["PYTHONPATH"] = str(Path(build.__file__).parents[2])
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.stdout == "1\n" and done.stderr.count("Warning: ") == 1, done.stderr


def test_without_a_compiler_the_users_choice_is_named(folder, monkeypatch):
    monkeypatch.setenv("CXX", "/nonexistent")
    assert build.load(written()).reason == "there is no C++ compiler (CXX=/nonexistent)"
    assert build.compiler() is None
    build._warn_of_none.cache_clear()
    with pytest.warns(LoweringWarning, match="physics runs in XLA.*CXX=/nonexistent.*install g"):
        assert not build.is_available()


@needs_compiler
def test_is_available_with_a_compiler_unless_turned_off(folder, monkeypatch):
    assert build.is_available()
    monkeypatch.setenv("REWAX_NATIVE", "0")
    assert not build.is_available()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_child_does_not_wait_for_a_thread_that_it_does_not_have():
    source = build.Source("never", "")
    with build._locks.setdefault(source, threading.Lock()):
        child = os.fork()
        if child == 0:
            os._exit(len(build._locks))
        assert os.waitpid(child, 0)[1] == 0
    del build._locks[source]
