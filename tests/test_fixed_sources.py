"""What a wheel brings is every program in C++."""

import re
import threading
import time
from pathlib import Path

from rewax.fixed_sources import build_ahead, fixed_sources
from rewax.lowering import build, shipped

ROOT = Path(__file__).resolve().parent.parent


def test_no_program_is_forgotten():
    texts = [path.read_text() for path in (ROOT / "rewax").rglob("*.py")]
    stems = {stem for text in texts for stem in re.findall(r"\bSource\(\s*\"(\w+)\"", text)}
    assert {source.stem for source in fixed_sources()} == stems


def test_their_libraries_have_different_names():
    names = [shipped.name(*source) for source in fixed_sources()]
    assert len(set(names)) == len(names) == 4
    assert names == [shipped.name(*source) for source in fixed_sources()]


def test_what_is_built_ahead_is_not_built_again(monkeypatch):
    asked = []
    monkeypatch.setattr(build, "_load", lambda source: asked.append(source) or build.Loaded(None, "for a test"))
    build._loaded.clear()
    try:
        build_ahead().join()
        assert [build.load(source).reason for source in asked] == ["for a test"] * 2
        assert len(asked) == 2 and set(asked) < set(fixed_sources())
    finally:
        build._loaded.clear()


def test_threads_that_ask_for_one_program_load_it_once(monkeypatch):
    asked = []

    def slow(source):
        asked.append(source)
        time.sleep(0.05)
        return build.Loaded(None, "for a test")

    monkeypatch.setattr(build, "_load", slow)
    build._loaded.clear()
    source = build.Source("empty", "// for a test of threads")
    try:
        threads = [threading.Thread(target=build.load, args=(source,)) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert asked == [source]
    finally:
        build._loaded.clear()
