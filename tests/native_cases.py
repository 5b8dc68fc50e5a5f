"""What tests of C++ need."""

import pytest

from rewax.physics.numerics import native

NEEDS_COMPILER = pytest.mark.skipif(
    native.compiler() is None or native.is_off(), reason="there is no C++ compiler, or REWAX_NATIVE=0"
)
