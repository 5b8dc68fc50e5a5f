"""Random programs give the numbers of JAX; ``benchmarks/fuzz_lowering.py`` draws thousands."""

import itertools
import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from native_cases import NEEDS_COMPILER

from benchmarks import fuzz_lowering
from benchmarks.fuzz_lowering import WAYS, check_program
from benchmarks.random_programs import RandomProgram, Value

PROGRAMS = 25
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


QUOTIENT = ([lambda a: a, jnp.reciprocal], {np.inf, -np.inf})
OVERFLOW = ([jnp.exp, lambda a: a * 3e37], {np.inf})


@pytest.mark.parametrize(
    ("rule", "steps", "right"), [("value", *OVERFLOW), ("value", *QUOTIENT), ("jvp", *QUOTIENT), ("vjp", *QUOTIENT)]
)
def test_another_result_than_an_infinite_one_is_reported(rule, steps, right, monkeypatch):
    """Only a quotient by a zero that is computed may be infinite with the other sign."""
    program = RandomProgram([Value((), "f")], [(f, (k,)) for k, f in enumerate(steps)], (2,), ["first", "reciprocal"])
    compute, computed = fuzz_lowering._results, []

    def results(*arguments, **options):
        """Those of the lowered program, then those of JAX, are the same for each ``instead``."""
        call = next(calls)
        if call > 1:
            return compute(*arguments, **options)
        if call == len(computed):
            computed.append(compute(*arguments, **options))
        found = list(computed[call])
        if call == 0:
            found[0] = np.where(np.isinf(found[0]), instead, found[0]).astype(instead.dtype)
        return found

    monkeypatch.setattr(fuzz_lowering, "draw_program", lambda _: program)
    monkeypatch.setattr(fuzz_lowering, "draw_inputs", lambda *_: [np.array([0.0, 4.0], np.float32)])
    monkeypatch.setattr(fuzz_lowering, "RULES", (rule,))
    monkeypatch.setattr(fuzz_lowering, "_lowered", lambda program, _: jax.vmap(program))
    monkeypatch.setattr(fuzz_lowering, "_results", results)
    for instead in (*(np.float32(number) for number in (np.inf, -np.inf, np.nan, 5.0)), np.float64(np.inf)):
        calls = itertools.count()
        outcome = check_program(random.Random(0), "interpreted")
        expected = instead not in right or instead.dtype == np.float64
        assert outcome.compared == 1 and bool(outcome.wrong) == expected, (instead, outcome.wrong)
