"""The Python code of the documentation's pages."""

import re
import runpy
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def code(page: str, needs: str = "") -> str:
    """All Python blocks of a page, one after the other: those that need nothing, or a library that the fence names."""
    fence = rf"^```python{' ' + needs if needs else ''}\n(.*?)^```"
    return "\n".join(re.findall(fence, (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL))


def run_page(page, needs="", shorter=()):
    """The names that a page's code leaves behind.

    Args:
      page: path from the root of the repository.
      needs: as for ``code``.
      shorter: pairs of a piece of the code and what runs in its place, to take less long.
    """
    names, source = {}, code(page, needs)
    for long, short in dict(shorter).items():
        assert source.count(long) == 1, long
        source = source.replace(long, short)
    exec(compile(source, page, "exec"), names)
    return names


def run_benchmark(name):
    """The names of a file of ``benchmarks/``, which finds its neighbours there."""
    folder = str(ROOT / "benchmarks")
    sys.path.append(folder)
    try:
        return runpy.run_path(f"{folder}/{name}.py")
    finally:
        sys.path.remove(folder)
