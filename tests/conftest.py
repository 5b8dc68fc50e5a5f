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


@pytest.fixture
def x64() -> Iterator[None]:
    """The test runs with float64 as the default."""
    with jax.enable_x64(True):
        yield
