"""C++ for CPUs: built once, kept, and done without where it cannot be built."""

import shutil

import pytest

from rewax.lowering import build
from rewax.physics.mpm import transfer_native

EMPTY = 'extern "C" int one() { return 1; }\n'
needs_compiler = pytest.mark.skipif(build.compiler() is None, reason="there is no C++ compiler")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("REWAX_NATIVE", raising=False)
    build.load.cache_clear()
    build.register.cache_clear()
    yield tmp_path
    build.load.cache_clear()
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
    build.load.cache_clear()
    assert build.load(source).reason == first.reason and built.stat().st_mtime_ns == when
    build.load.cache_clear()
    assert build.load(written(EMPTY.replace("1", "2"))).library.one() == 2


@needs_compiler
def test_a_cache_that_cannot_be_written_does_not_matter(folder, monkeypatch):
    (folder / "cache").write_text("a file")
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
    assert not transfer_native.is_used()


def test_can_be_turned_off(folder, monkeypatch):
    monkeypatch.setenv("REWAX_NATIVE", "0")
    assert build.load(written()) == (None, "REWAX_NATIVE=0 is set")
