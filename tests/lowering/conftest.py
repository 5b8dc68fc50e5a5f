"""Helpers of the compiler's tests, as fixtures."""

import jax
import pytest


@pytest.fixture(scope="module", autouse=True)
def release_programs():
    """Programs of one module are no use to the next, and each keeps memory and many memory maps."""
    yield
    jax.clear_caches()
