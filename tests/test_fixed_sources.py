"""What a wheel brings is every program in C++."""

import re
from pathlib import Path

from rewax.fixed_sources import fixed_sources
from rewax.lowering import shipped

ROOT = Path(__file__).resolve().parent.parent


def test_no_program_is_forgotten():
    texts = [path.read_text() for path in (ROOT / "rewax").rglob("*.py")]
    stems = {stem for text in texts for stem in re.findall(r"\bSource\(\s*\"(\w+)\"", text)}
    assert {source.stem for source in fixed_sources()} == stems


def test_their_libraries_have_different_names():
    names = [shipped.name(*source) for source in fixed_sources()]
    assert len(set(names)) == len(names) == 4
    assert names == [shipped.name(*source) for source in fixed_sources()]
