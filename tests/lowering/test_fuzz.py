"""Random programs give the numbers of JAX; ``benchmarks/fuzz_lowering.py`` draws thousands."""

import random

import jax
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from benchmarks.fuzz_lowering import WAYS, check_program

NUM_PROGRAMS = 8
"""In each case."""


@NEEDS_COMPILER
@pytest.mark.parametrize("first", range(3000, 3048, NUM_PROGRAMS))
def test_random_programs(first):
    for seed in range(first, first + NUM_PROGRAMS):
        precision = np.float64 if seed % 5 == 4 else np.float32
        outcome = check_program(random.Random(seed), WAYS[seed % 2], precision=precision)
        assert not outcome.wrong, (seed, outcome.wrong)
        assert outcome.compared or outcome.refused
    jax.clear_caches()
