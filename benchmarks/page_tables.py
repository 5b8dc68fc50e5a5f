"""Put the tables that a benchmark prints in place of those with the same first line on a page.

    python benchmarks/seeing.py --table | python benchmarks/page_tables.py docs/policies_that_see.md
    python benchmarks/identify_cases.py --report | python benchmarks/page_tables.py docs/identify.md

The text around the tables stays. A table without a counterpart on the page, or with two, is an error.
"""

import re
import sys
from collections.abc import Iterable
from pathlib import Path

TABLE = re.compile(r"(?:^\|.*\n?)+", re.MULTILINE)


def tables(text: str) -> list[str]:
    """The tables of a Markdown text, without the line's end of their last row."""
    return [found.rstrip("\n") for found in TABLE.findall(text)]


def filled(page: str, new: Iterable[str]) -> str:
    """The page with those tables in place of its own.

    Raises:
      ValueError: the page has no table with the first line of one of them, or several.
    """
    for table in new:
        head = table.splitlines()[0]
        old = [t for t in tables(page) if t.splitlines()[0] == head]
        if len(old) != 1:
            raise ValueError(f"the page has {len(old)} tables that begin with {head!r}: it needs one")
        page = page.replace(old[0], table)
    return page


def main(path: Path, printed: str) -> int:
    path.write_text(filled(path.read_text(), tables(printed)))
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    raise SystemExit(main(Path(sys.argv[1]), sys.stdin.read()))
