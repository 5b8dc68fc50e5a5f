"""Random programs give the numbers of JAX; ``benchmarks/fuzz_lowering.py`` draws thousands."""

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from native_cases import NEEDS_COMPILER

from benchmarks.fuzz_lowering import WAYS, check_program

PROGRAMS = 40
"""For each way and precision."""


@NEEDS_COMPILER
@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("way", WAYS)
def test_random_programs(way, precision):
    drawn, compared = 0, 0

    @settings(max_examples=PROGRAMS, deadline=None, derandomize=True, database=None, suppress_health_check=HealthCheck)
    @given(st.randoms(use_true_random=False))
    def check(rng):
        nonlocal drawn, compared
        outcome = check_program(rng, way, precision=precision)
        assert not outcome.wrong
        assert outcome.compared or outcome.refused
        drawn, compared = drawn + 1, compared + outcome.compared
        if drawn % 20 == 0:
            jax.clear_caches()

    check()
    assert compared > 0.8 * drawn
