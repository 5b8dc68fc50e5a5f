"""What pyproject.toml declares is what the package imports, and the command that it installs exists."""

import ast
import importlib
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import rewax

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DISTRIBUTIONS = {
    "orbax.checkpoint": "orbax-checkpoint", "mujoco.mjx": "mujoco-mjx", "imageio_ffmpeg": "imageio-ffmpeg", "OpenGL": "pyopengl",
    "PIL": "pillow",
}  # fmt: skip
"""Where a distribution has another name than its top module."""
EXTRA_MODULES = {
    "scikit-image": "skimage", "dm-env": "dm_env", "stable-baselines3": "stable_baselines3", "pytest-xdist": "xdist", "ott-jax": "ott",
}  # fmt: skip
"""The same of extras."""


def third_party(folder: Path) -> set[str]:
    """Distributions that Python files import anywhere, inside functions too."""
    modules = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                modules |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                modules |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    found = {distribution for module, distribution in DISTRIBUTIONS.items() if module in modules}
    tops = {module.split(".")[0] for module in modules} - {"orbax", "rewax", "imageio_ffmpeg", "OpenGL", "PIL"}
    return found | (tops - set(sys.stdlib_module_names))


def declared(requirements: list[str]) -> set[str]:
    return {re.match(r"[\w.-]+", requirement)[0] for requirement in requirements}


def extras(*names: str) -> set[str]:
    """Modules that extras bring, those of the extras that they name included."""
    found: set[str] = set()
    for name in names:
        requirements = PROJECT["optional-dependencies"][name]
        found |= declared([r for r in requirements if not r.startswith("rewax[")])
        for inner in (r for r in requirements if r.startswith("rewax[")):
            found |= extras(*inner[len("rewax[") : inner.index("]")].split(","))
    return {EXTRA_MODULES.get(name, name) for name in found}


def test_every_dependency_is_imported_and_every_import_declared():
    used, core = third_party(ROOT / "rewax"), declared(PROJECT["dependencies"])
    optional = extras(
        "meshes",
        "surfaces",
        "live",
        "wandb",
        "gymnasium",
        "dm-env",
        "torch",
        "stable-baselines3",
        "tune",
        "identify",
    )
    assert core <= used, f"declared but not imported by rewax: {sorted(core - used)}"
    assert used - core == optional, f"imported by rewax but not declared: {sorted(used - core - optional)}"


def test_tests_and_examples_import_only_what_is_declared():
    known = declared(PROJECT["dependencies"]) | extras("test", "stable-baselines3")
    for folder in ("tests", "examples"):
        own = {path.stem for path in (ROOT / folder).rglob("*.py")} | {"tests", "benchmarks"}
        assert third_party(ROOT / folder) - known - own == set()


def test_an_import_and_a_dependency_too_many_are_found(tmp_path):
    (tmp_path / "a.py").write_text(
        "def f():\n    from mujoco import mjx\n    import orbax.checkpoint as ocp, os, jax.numpy\n"
    )
    assert third_party(tmp_path) == {"mujoco", "mujoco-mjx", "orbax-checkpoint", "jax"}
    (tmp_path / "b.py").write_text("from absent.part import name\n")
    assert third_party(tmp_path) == {"mujoco", "mujoco-mjx", "orbax-checkpoint", "jax", "absent"}


def test_what_is_not_python_is_not_ignored_by_git_and_so_goes_into_the_wheel():
    """Hatchling packs every file of the package that git would keep."""
    ignored = [line.rstrip("/").lstrip("*") for line in (ROOT / ".gitignore").read_text().splitlines() if line]
    assets = [
        path
        for path in (ROOT / "rewax").rglob("*")
        if path.suffix in (".html", ".css", ".js", ".xml", ".toml", ".cc", ".npz", ".json")
    ]
    assert {"player.html", "player.css", "player.js", "ant.xml", "transfer.cc", "RollingFlat-small.npz"} <= {
        path.name for path in assets
    }
    assert not [path for path in assets if path.suffix in ignored or set(path.relative_to(ROOT).parts) & set(ignored)]


def version_script(root: Path, *arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, root / ".ci/version", *arguments], capture_output=True, text=True)


@pytest.mark.skipif(not (ROOT / ".ci").is_dir(), reason="not in the sdist")
def test_there_is_one_version(tmp_path):
    done = version_script(ROOT)
    assert done.returncode == 0 and done.stdout.strip() == rewax.__version__, done.stderr
    files = ("rewax/__init__.py", "CITATION.cff", "CHANGELOG.md", ".ci/version")
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    changes = (tmp_path / "CHANGELOG.md").read_text()
    heading = re.search(r"^## .*$", changes, re.M)[0]
    assert "before a release" in version_script(tmp_path, rewax.__version__).stderr
    (tmp_path / "CHANGELOG.md").write_text(changes.replace(heading, f"## {rewax.__version__}, 2026-01-31"))
    assert version_script(tmp_path, rewax.__version__).returncode == 0
    assert "the tag is of version 9.9.9" in version_script(tmp_path, "9.9.9").stderr
    assert version_script(tmp_path, "--notes").stdout.startswith("### Added")
    (tmp_path / "CHANGELOG.md").write_text(changes.replace(heading, "## 9.9.9, 2026-01-31"))
    assert "the first heading of CHANGELOG.md" in version_script(tmp_path).stderr
    (tmp_path / "CITATION.cff").write_text("version: 9.9.9\n")
    assert "CITATION.cff has 9.9.9" in version_script(tmp_path).stderr


@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_the_command_exists(name):
    module, function = PROJECT["scripts"][name].split(":")
    assert callable(getattr(importlib.import_module(module), function))
