"""Shared by all tests: a compile cache that outlives the run, few but repeatable hypothesis examples, float64."""

import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import pytest

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
