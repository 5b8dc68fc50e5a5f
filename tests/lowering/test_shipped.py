"""Libraries that come with rewax: chosen by the processor and JAX, used only for their own source, replaced if refused."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from rewax.lowering import build, compiler, library_cache, shipped

REAL = compiler.command()
needs_compiler = pytest.mark.skipif(REAL is None, reason="there is no C++ compiler")
V2 = ("cx16", "lahf_lm", "popcnt", "pni", "sse4_1", "sse4_2", "ssse3", "sse2", "fpu")
V3 = (*V2, "abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "xsave")
V4 = (*V3, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx512_vnni")
SOURCE = build.Source("two", 'extern "C" int two() { return 2; }\n')
HANDLER = build.Source(
    "handler",
    '#include "xla/ffi/api/ffi.h"\nnamespace ffi = xla::ffi;\n'
    "static ffi::Error Run(ffi::ResultBuffer<ffi::F32> r) { r->typed_data()[0] = 2; return ffi::Error::Success(); }\n"
    "XLA_FFI_DEFINE_HANDLER_SYMBOL(rewax_test_shipped, Run, ffi::Ffi::Bind().Ret<ffi::Buffer<ffi::F32>>());\n",
    ("-O1",),
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder of shipped libraries, an empty cache, and a processor of the level v3 under JAX's own version."""
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "shipped")
    monkeypatch.setattr(shipped.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(shipped.sys, "platform", "linux")
    monkeypatch.setattr(shipped, "ffi_version", lambda include: (0, 3))
    monkeypatch.setattr(compiler, "processor_flags", lambda: V3)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("REWAX_NATIVE", raising=False)
    monkeypatch.setattr(build, "_refused", set())
    build._loaded.clear()
    build.register.cache_clear()
    yield tmp_path / "shipped"
    build._loaded.clear()
    build.register.cache_clear()


def ship(folder, source=SOURCE, level="x86-64-v3", version="0.3", text=None, options=()):
    """Put a library where one that comes with rewax would be."""
    home = folder / f"ffi-{version}" / level
    home.mkdir(parents=True, exist_ok=True)
    with library_cache._build_folder(folder) as empty:
        made = compiler.build(REAL, text or source.text, (*compiler.FLAGS, *options), empty)
    return library_cache.keep(home, shipped.name(*source), made)


def ship_refused(folder, tmp_path, source):
    """A library that JAX refuses, although the folder's name says that it is old enough."""
    include = tmp_path / "include"
    shutil.copytree(jax.ffi.include_dir(), include)
    header = include / "xla" / "ffi" / "api" / "c_api.h"
    header.write_text(header.read_text().replace("#define XLA_FFI_API_MINOR ", "#define XLA_FFI_API_MINOR 9"))
    return ship(folder, source, version="0.2", options=("-I", str(include)))


@pytest.mark.parametrize(
    ("flags", "levels"),
    [
        (V4, ["x86-64-v4", "x86-64-v3", "x86-64-v2"]),
        (V3, ["x86-64-v3", "x86-64-v2"]),
        (V2, ["x86-64-v2"]),
        (("fpu",), []),
        ((), []),
        ([flag for flag in V4 if flag != "fma"], ["x86-64-v2"]),  # a virtual machine that hides one
    ],
)
def test_levels_of_processors(flags, levels):
    assert shipped.processor_levels(tuple(flags)) == levels


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="there is no /proc")
def test_levels_of_this_processor_run():
    """The levels that /proc/cpuinfo shows are those for which the compiler's macros hold."""
    flags = set(compiler.processor_flags())
    assert ("x86-64-v3" in shipped.processor_levels(tuple(flags))) == ({"avx2", "fma", "bmi2", "movbe"} <= flags)


@needs_compiler
def test_the_best_level_is_loaded_without_a_compiler(folder, monkeypatch):
    monkeypatch.setenv("CXX", "/nonexistent")
    for level in shipped.LEVELS:
        ship(folder, level=level)
    library, reason = build.load(SOURCE)
    assert library.two() == 2 and reason.startswith(str(folder / "ffi-0.3" / "x86-64-v3" / "two-"))
    assert build.is_available()


@needs_compiler
def test_another_source_is_never_stood_for(folder, monkeypatch):
    """An edited checkout builds what it says."""
    ship(folder)
    edited = SOURCE._replace(text=SOURCE.text.replace("return 2", "return 3"))
    library, reason = build.load(edited)
    assert library.two() == 3 and "cache" in reason
    assert shipped.find(*SOURCE) and not shipped.find(*SOURCE._replace(optimization=("-O2",)))
    build._loaded.clear()
    monkeypatch.setenv("CXX", "/nonexistent")
    assert build.load(edited).library is None


@needs_compiler
def test_a_damaged_one_is_not_used(folder, monkeypatch):
    ship(folder, level="x86-64-v2")
    path = ship(folder)
    os.truncate(path, 5000)
    with pytest.warns(UserWarning, match="x86-64-v3/two.* is not used: it is damaged"):
        library, reason = build.load(SOURCE)
    assert library.two() == 2 and "x86-64-v2" in reason and path.exists()


@needs_compiler
@pytest.mark.parametrize(
    ("version", "used"), [("0.3", True), ("0.2", True), ("0.4", False), ("1.0", False), ("x", False)]
)
def test_headers_newer_than_jax_are_not_used(folder, version, used):
    ship(folder, version=version)
    assert (shipped.find(*SOURCE) is not None) == used


@needs_compiler
def test_can_be_turned_off(folder, monkeypatch):
    ship(folder)
    monkeypatch.setenv("REWAX_NATIVE", "build")
    assert "cache" in build.load(SOURCE).reason
    monkeypatch.setenv("CXX", "/nonexistent")
    assert not build.is_available()


def test_other_platforms_have_none(folder, monkeypatch):
    (folder / "ffi-0.3" / "x86-64-v2").mkdir(parents=True)
    assert len(shipped.folders()) == 1
    monkeypatch.setattr(shipped.platform, "machine", lambda: "aarch64")
    assert shipped.folders() == []


def test_the_version_of_the_interface_is_read_from_the_headers(tmp_path):
    major, minor = shipped.ffi_version(jax.ffi.include_dir())
    assert (major, minor) >= (0, 1)
    assert shipped.ffi_version(str(tmp_path)) is None


@needs_compiler
@pytest.mark.parametrize("with_compiler", [True, False])
def test_one_that_jax_refuses_is_built(folder, monkeypatch, tmp_path, with_compiler):
    """Its headers are newer, whatever the folder's name says."""
    source = HANDLER._replace(text=HANDLER.text.replace("shipped", f"shipped_{with_compiler}"))
    jax.devices()
    ship_refused(folder, tmp_path, source)
    if not with_compiler:
        monkeypatch.setenv("CXX", "/nonexistent")
    name = f"rewax_test_shipped_{with_compiler}"
    assert "shipped" in build.load(source).reason
    assert build.register(source, (name,)) == with_compiler
    found = build.load(source)
    if with_compiler:
        assert "cache" in found.reason
        assert jax.jit(lambda: jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((1,), "float32"))())()[0] == 2
    else:
        assert found == (None, "there is no C++ compiler (CXX=/nonexistent)")


@needs_compiler
def test_a_refusal_does_not_break_jax(tmp_path):
    """Whoever registers a refused library before there is a CPU's backend never gets one."""
    program = (
        "import sys\nfrom pathlib import Path\nimport jax\nimport test_shipped as t\n"
        "t.shipped.FOLDER = Path(sys.argv[1]) / 'shipped'\nt.compiler.processor_flags = lambda: t.V3\n"
        "t.ship_refused(t.shipped.FOLDER, Path(sys.argv[1]), t.HANDLER)\n"
        "assert 'ffi-0.2' in t.build.load(t.HANDLER).reason\n"
        "assert t.build.register(t.HANDLER, ('rewax_test_shipped',))\n"
        "print(jax.jit(lambda: jax.ffi.ffi_call('rewax_test_shipped', jax.ShapeDtypeStruct((1,), 'float32'))())())\n"
    )
    root = Path(__file__).resolve().parents[2]
    environment = {
        **os.environ, "XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": f"{root}{os.pathsep}{root / 'tests' / 'lowering'}",
    }  # fmt: skip
    environment.pop("REWAX_NATIVE", None)
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], env=environment, capture_output=True, text=True
    )
    assert done.stdout == "[2.]\n", done.stderr


@needs_compiler
def test_one_built_with_these_headers_is_registered(folder):
    source = HANDLER._replace(text=HANDLER.text.replace("shipped", "accepted"))
    ship(folder, source, options=("-I", jax.ffi.include_dir()))
    assert build.register(source, ("rewax_test_accepted",))
    assert build.load(source).reason.startswith(str(folder))
