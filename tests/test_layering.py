"""Data flows one way: no module imports one of a later layer."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ALLOWED = {
    "base": set(),
    "physics": {"base"},
    "viz": {"base"},
    "envs": {"base", "physics"},
    "agents": {"base", "physics", "envs"},
    "training": {"base", "physics", "envs", "agents", "viz"},
    "testing": {"base", "physics", "envs"},
    "debug": {"base", "physics"},
    "top": {"base", "physics", "envs", "agents", "training", "viz", "testing"},
}
"""Layers, and what each may import besides itself."""
_BASE = {"types", "struct", "status", "py.typed"}


def layer(module: str) -> str:
    """Layer of a dotted module name that begins with ``rewax``."""
    part = ([*module.split("."), ""])[1]
    return "base" if part in _BASE else part if part in ALLOWED else "top"


def module_name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path: Path, root: Path) -> set[str]:
    """Modules of rewax that a file imports anywhere, inside functions too."""
    found = set()
    package = module_name(path, root).split(".")[: None if path.name == "__init__.py" else -1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) + "." if node.level else ""
            source = (base + (node.module or "")).rstrip(".")
            # `from rewax import struct` imports a module, `from rewax.struct import field` a name in it
            names = [f"{source}.{alias.name}" for alias in node.names] if source == "rewax" else [source]
            found |= set(names)
    return {name for name in found if name.split(".")[0] == "rewax"}


def violations(root: Path) -> list[str]:
    wrong = []
    for path in sorted((root / "rewax").rglob("*.py")):
        here = layer(module_name(path, root))
        for name in sorted(imports(path, root)):
            there = layer(name)
            if there != here and there not in ALLOWED[here]:
                wrong.append(f"{path.relative_to(root)} ({here}) imports {name} ({there})")
    return wrong


def test_no_import_goes_up():
    assert not violations(ROOT), "\n".join(violations(ROOT))


def test_nothing_imports_examples_or_tests():
    for path in (ROOT / "rewax").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                assert node.module.split(".")[0] not in ("examples", "tests", "toys"), path


@pytest.mark.parametrize(
    ("path", "line"),
    [
        ("physics/a.py", "from rewax.envs.base import Env"),
        ("physics/a.py", "import rewax.agents.base"),
        ("envs/a.py", "def f():\n    from rewax.agents import sapo"),
        ("envs/a.py", "from ..agents import sapo"),
        ("agents/a.py", "from rewax.training.loop import train"),
        ("agents/a.py", "from rewax import viz"),
        ("viz/a.py", "from rewax.training.metrics import read_csv"),
        ("struct.py", "from rewax.physics import mpm"),
    ],
)
def test_an_upward_import_is_found(tmp_path, path, line):
    file = tmp_path / "rewax" / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("from rewax import types\n")
    assert not violations(tmp_path)
    file.write_text(line + "\n")
    assert len(violations(tmp_path)) == 1
