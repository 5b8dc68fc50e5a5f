"""The wheel brings libraries where they can be built, says its platform, and is pure where they cannot."""

import importlib.util
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import pytest

from rewax.fixed_sources import fixed_sources
from rewax.lowering import compiler, library_cache, shipped

ROOT = Path(__file__).resolve().parent.parent
LINUX = pytest.mark.skipif(
    not sys.platform.startswith("linux") or shipped.platform.machine() != "x86_64", reason="for Linux on x86-64"
)


def build_hook():
    pytest.importorskip("hatchling")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_wheel(folder, **environment):
    """The wheel of this directory and what the build says."""
    pytest.importorskip("hatchling")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    environment = {**os.environ, **environment}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = Path(folder).glob("*.whl")
    return wheel, done.stdout + done.stderr


def libraries(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return [name for name in archive.namelist() if name.endswith(".so")]


@LINUX
@pytest.mark.skipif(compiler.command() is None, reason="there is no C++ compiler")
def test_a_wheel_with_libraries(tmp_path):
    wheel, _ = make_wheel(tmp_path, REWAX_WHEEL_LEVELS="x86-64-v2")
    assert wheel.name.startswith("rewax-") and "-py3-none-manylinux_2_" in wheel.name
    home = tmp_path / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(home)
    version = "ffi-{}.{}".format(*shipped.ffi_version(jax.ffi.include_dir()))
    folder = home / "rewax" / "lowering" / "shipped_libraries" / version / "x86-64-v2"
    for source in fixed_sources():
        path, damaged = library_cache.find(folder, shipped.name(*source), private=False)
        assert path and not damaged, source.stem
    assert len(libraries(wheel)) == len(fixed_sources())
    if shipped.processor_levels(compiler.processor_flags()):
        program = (
            "from rewax.fixed_sources import fixed_sources\nfrom rewax.lowering import build\n"
            "print({build.load(source).reason.rpartition('/')[0] for source in fixed_sources()})\n"
            "from rewax.physics.mpm import transfer_cpp\nprint(transfer_cpp.is_used())"
        )
        environment = {**os.environ, "PYTHONPATH": str(home), "CXX": "/nonexistent", "REWAX_NATIVE": "1"}
        done = subprocess.run(
            [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.stdout == f"{{'{folder}'}}\nTrue\n", done.stderr


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"CXX": "/nonexistent"}, "there is no C++ compiler" if sys.platform == "linux" else ""),
        ({"REWAX_WHEEL_LEVELS": "none"}, "REWAX_WHEEL_LEVELS=none is set"),
    ],
)
def test_a_wheel_without(tmp_path, environment, said):
    wheel, output = make_wheel(tmp_path, **{"REWAX_WHEEL_LEVELS": "x86-64-v2"} | environment)
    assert wheel.name.endswith("-py3-none-any.whl") and not libraries(wheel)
    assert output.count("This wheel brings no C++ libraries: ") == 1 and said in output


def test_an_unknown_level_is_named(tmp_path, monkeypatch):
    hook = build_hook()
    if hook.reason_for_none() or compiler.command() is None:
        pytest.skip("no libraries here")
    monkeypatch.setenv("REWAX_WHEEL_LEVELS", "x86-64-v5")
    with pytest.raises(ValueError, match="REWAX_WHEEL_LEVELS=x86-64-v5: choose of x86-64-v4, x86-64-v3, x86-64-v2"):
        hook.build_libraries(ROOT, tmp_path)


@pytest.mark.parametrize(
    ("contents", "tag"),
    [
        ([b"GLIBC_2.2.5", b"GLIBC_2.34 GLIBC_2.4"], "manylinux_2_34_x86_64"),
        ([b"GLIBC_2.2.5"], "manylinux_2_17_x86_64"),
        ([b"GLIBC_2.34 libstdc++.so.6"], "linux_x86_64"),
        ([b"another C library"], "linux_x86_64"),
    ],
)
def test_the_platform_is_the_oldest_that_has_what_libraries_need(tmp_path, contents, tag):
    files = []
    for k, content in enumerate(contents):
        files.append(tmp_path / f"{k}.so")
        files[-1].write_bytes(content)
    assert build_hook().platform_tag(files) == tag


def test_an_editable_build_needs_nothing(monkeypatch):
    hook = build_hook()
    monkeypatch.delenv("REWAX_WHEEL_LEVELS", raising=False)
    monkeypatch.setattr(hook, "reason_for_none", lambda: None)
    of = hook.LibrariesHook.dependencies
    monkeypatch.setattr(sys, "argv", ["_in_process.py", "get_requires_for_build_editable"])
    assert of(None) == []
    monkeypatch.setattr(sys, "argv", ["_in_process.py", "get_requires_for_build_wheel"])
    assert of(None)[0].startswith("jax==")
