"""What tests of C++ need."""

import pytest

from rewax.lowering import build

NEEDS_COMPILER = pytest.mark.skipif(
    build.compiler() is None or build.is_off(), reason="there is no C++ compiler, or REWAX_NATIVE=0"
)
