"""Shared by all tests: programs that compile fast and stay in a cache, few but repeatable hypothesis examples, float64."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import pytest

_QUICK_TO_COMPILE = "--xla_cpu_use_fusion_emitters=false"
"""XLA's older code generator for a CPU: a third less to compile, programs up to 1.4 times as slow."""


def _knows(flag: str) -> bool:
    """Whether this XLA has the flag: one that has not ends the process."""
    environment = {**os.environ, "XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    return subprocess.run(command, env=environment, capture_output=True).returncode == 0


# Before jax starts. Workers inherit it. Flags that are set, even to nothing (`XLA_FLAGS= pytest`), stay as they are.
if "XLA_FLAGS" not in os.environ and _knows(_QUICK_TO_COMPILE):
    os.environ["XLA_FLAGS"] = _QUICK_TO_COMPILE

_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rewax" / "jax-tests"
jax.config.update("jax_compilation_cache_dir", str(_CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

hypothesis.settings.register_profile(
    "rewax",
    max_examples=12,
    deadline=None,
    derandomize=True,
    print_blob=True,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
)
hypothesis.settings.load_profile("rewax")


_MANY_MAPS = 20_000
"""Linux lets a process map 65530 pieces of memory; every compiled program takes some, and beyond it crashes."""


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """Compiled programs of earlier modules go before they are too many; the cache on disk keeps them."""
    yield
    maps = Path("/proc/self/maps")
    if maps.is_file() and maps.read_bytes().count(b"\n") > _MANY_MAPS:
        jax.clear_caches()


@pytest.fixture
def x64() -> Iterator[None]:
    """The test runs with float64 as the default."""
    with jax.enable_x64(True):
        yield
