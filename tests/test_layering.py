"""Data flows one way: no module imports one of a later layer."""

import ast
import functools
import statistics
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = {"physics.numerics", "physics.shapes", "physics.contact"}
SOLVERS = {"physics.mpm", "physics.tets", "physics.thin", "physics.rigid"}
PHYSICS = SHARED | SOLVERS | {"physics", "physics.coupling"}
ALLOWED = {
    "base": set(),
    "lowering": {"base"},
    "physics": {"base"},
    "physics.numerics": {"base", "lowering"},
    "physics.shapes": {"base", "lowering", "physics.numerics"},
    "physics.contact": {"base", "lowering", "physics.numerics", "physics.shapes"},
    **{solver: {"base", "lowering"} | SHARED for solver in SOLVERS},
    "physics.coupling": {"base", "lowering"} | SHARED | SOLVERS,
    "fixed_sources": {"base", "lowering"} | PHYSICS,
    "viz": {"base"},
    "sensors": {"base"} | PHYSICS,
    "envs": {"base", "sensors"} | PHYSICS,
    "identify": {"base", "sensors", "envs"} | PHYSICS,
    "agents": {"base", "lowering", "sensors", "envs"} | PHYSICS,
    "training": {"base", "lowering", "sensors", "envs", "agents", "viz"} | PHYSICS,
    "testing": {"base", "lowering", "sensors", "envs", "agents", "viz"} | PHYSICS,
    "adapters": {"base", "sensors", "envs", "training", "viz"},
    "debug": {"base"} | PHYSICS,
    "cli": {"base", "lowering", "sensors", "envs", "identify", "agents", "training", "viz", "testing", "fixed_sources"}
    | PHYSICS,
    "top": {"base", "lowering", "sensors", "envs", "identify", "agents", "training", "viz", "testing", "cli"} | PHYSICS,
}
"""Floors, and what each may import besides itself. Solvers do not import each other; only coupling knows several."""
_BASE = {
    "jax_versions",
    "lazy",
    "types",
    "short_repr",
    "struct",
    "status",
    "statistics",
    "xla_options",
    "whole_files",
    "py.typed",
}
MAX_LINES, MAX_MEDIAN, MAX_INIT = 400, 150, 40


def layer(module: str) -> str:
    """Floor of a dotted module name that begins with ``rewax``."""
    parts = [*module.split("."), "", ""][1:3]
    if ".".join(parts) in ALLOWED:
        return ".".join(parts)
    return "base" if parts[0] in _BASE else parts[0] if parts[0] in ALLOWED else "top"


def module_name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def import_nodes(text: str) -> list[ast.Import | ast.ImportFrom]:
    """All imports of a source text, those inside functions too."""
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]


def imports(path: Path, root: Path) -> set[str]:
    """Modules of rewax that a file imports anywhere, inside functions too."""
    found = set()
    package = module_name(path, root).split(".")[: None if path.name == "__init__.py" else -1]
    for node in import_nodes(path.read_text()):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        else:
            base = ".".join(package[: len(package) - node.level + 1]) + "." if node.level else ""
            source = (base + (node.module or "")).rstrip(".")
            # `from rewax import struct` imports a module, `from rewax.struct import field` a name in it
            whole = source in ("rewax", "rewax.physics")
            names = [f"{source}.{alias.name}" for alias in node.names] if whole else [source]
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
        for node in import_nodes(path.read_text()):
            if isinstance(node, ast.ImportFrom) and node.module:
                assert node.module.split(".")[0] not in ("examples", "tests", "toys"), path


@pytest.mark.parametrize(
    ("path", "line"),
    [
        ("physics/a.py", "from rewax.envs.base import Env"),
        ("physics/a.py", "import rewax.agents.base"),
        ("envs/a.py", "def f():\n    from rewax.agents import sapo"),
        ("envs/a.py", "from ..agents import sapo"),
        ("agents/a.py", "from rewax.training.loop.train import train"),
        ("training/a.py", "from rewax.cli.options import parse"),
        ("agents/a.py", "from rewax import viz"),
        ("identify/a.py", "from rewax.agents import sapo"),
        ("envs/a.py", "from rewax.identify.records import Record"),
        ("viz/a.py", "from rewax.training.storage.metrics import read_csv"),
        ("struct.py", "from rewax.physics import mpm"),
        ("lowering/a.py", "from rewax.physics.numerics import components"),
        ("physics/numerics/a.py", "from rewax.physics.shapes import Box"),
        ("physics/shapes/a.py", "from rewax.physics.contact.colliders import Collider"),
        ("physics/contact/a.py", "from rewax.physics import mpm"),
        ("physics/tets/a.py", "from rewax.physics.mpm.materials import Material"),
        ("physics/mpm/a.py", "from rewax.physics import rigid"),
        ("physics/rigid/a.py", "from rewax.physics import coupling"),
    ],
)
def test_an_upward_import_is_found(tmp_path, path, line):
    file = tmp_path / "rewax" / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("from rewax import types\n")
    assert not violations(tmp_path)
    file.write_text(line + "\n")
    assert len(violations(tmp_path)) == 1


def test_no_package_shadows_its_modules():
    """``from rewax.physics.mpm import step`` gives the function, so no module has that name."""
    for init in sorted((ROOT / "rewax").rglob("__init__.py")):
        modules = {path.stem for path in init.parent.glob("*.py")}
        names = {
            alias.asname or alias.name
            for node in import_nodes(init.read_text()) if isinstance(node, ast.ImportFrom)
            for alias in node.names if node.module != module_name(init, ROOT)
        }  # fmt: skip
        assert not names & modules, f"{init} hides modules of its own"


def test_what_tasks_are_made_of_knows_no_task():
    for path in (ROOT / "rewax/envs/kit").glob("*.py"):
        assert not [name for name in imports(path, ROOT) if name.startswith("rewax.envs.tasks")], path


def test_files_are_short():
    lines = {path: len(path.read_text().splitlines()) for path in (ROOT / "rewax").rglob("*.py")}
    tests = {path: len(path.read_text().splitlines()) for path in (ROOT / "tests").rglob("*.py")}
    long = {str(path.relative_to(ROOT)): n for path, n in (lines | tests).items() if n > MAX_LINES}
    assert not long, f"over {MAX_LINES} lines: {long}"
    inits = {str(path): n for path, n in lines.items() if path.name == "__init__.py" and n > MAX_INIT}
    assert not inits, f"over {MAX_INIT} lines: {inits}"
    assert statistics.median(n for path, n in lines.items() if path.name != "__init__.py") <= MAX_MEDIAN


@pytest.mark.parametrize("package", ["lowering", "physics"])
def test_every_source_file_has_a_test_file(package):
    missing = [
        str(path.relative_to(ROOT))
        for path in (ROOT / "rewax" / package).rglob("*.py")
        if path.name != "__init__.py" and not mirrored(path).is_file()
    ]
    assert not missing, f"give these a test file: {missing}"


def mirrored(source: Path) -> Path:
    """The test file of a source file."""
    inside = source.relative_to(ROOT / "rewax")
    return ROOT / "tests" / inside.parent / f"test_{inside.name}"
