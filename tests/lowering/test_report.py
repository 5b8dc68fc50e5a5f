"""Where rules run: recorded, and named once where that is XLA."""

import functools
import warnings

import jax
import jax.numpy as jnp
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import interpreted, kernels, machine, pointwise, report
from rewax.lowering.report import Decision, LoweringWarning, name_of, note, recorded


def sorted_squares(a):
    return jnp.sort(a) ** 2


@pytest.fixture(autouse=True)
def nothing_named(monkeypatch):
    monkeypatch.setattr(report, "_named", set())


@NEEDS_COMPILER
def test_what_is_left_to_xla_is_named_once_with_its_reason():
    call = interpreted(sorted_squares)
    with (
        recorded() as decisions,
        pytest.warns(LoweringWarning, match="the value of .*sorted_squares runs in XLA.*sort"),
    ):
        call(jnp.ones(3))
    with recorded() as again, warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda a: call(a))(jnp.ones(3))
    assert decisions == again == [Decision(name_of(sorted_squares), "value", "it has the operation sort")]


@NEEDS_COMPILER
def test_what_runs_in_cpp_is_recorded_without_a_word():
    with recorded() as decisions, warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.grad(lambda a: pointwise(lambda s, e: e * s)(2.0, a).sum())(jnp.ones(3))
    assert {(d.rule, d.reason) for d in decisions} == {("value", None), ("cotangent", None)}
    assert str(decisions[0]).endswith("<lambda>, the value: C++")


@NEEDS_COMPILER
def test_a_fault_of_the_compiler_is_a_reason_not_an_error(monkeypatch):
    monkeypatch.setattr(machine, "from_jaxpr", lambda *args, **options: 1 / 0)
    with pytest.warns(LoweringWarning, match="could not be lowered .ZeroDivisionError"):
        assert interpreted(lambda a: a + 3)(jnp.ones(())) == 4


@NEEDS_COMPILER
def test_a_fault_while_tracing_is_a_reason_too(monkeypatch):
    monkeypatch.setattr(machine, "trace_rule", lambda *args: 1 / 0)
    with pytest.warns(LoweringWarning, match="could not be lowered .ZeroDivisionError"):
        assert interpreted(lambda a: a + 4)(jnp.ones(())) == 5


@NEEDS_COMPILER
def test_a_fault_in_a_kernel_is_a_reason_too(monkeypatch):
    monkeypatch.setattr(kernels, "bytecode_of", lambda *args: 1 / 0)
    with pytest.warns(LoweringWarning, match="could not be lowered .ZeroDivisionError"):
        assert pointwise(lambda s, a: a + 5)(None, jnp.ones(1))[0] == 6


class Law:
    def __call__(self, shared, a):
        return a * shared


@NEEDS_COMPILER
@pytest.mark.parametrize(
    ("law", "name"), [(functools.partial(lambda k, s, a: k * s * a, 3.0), "<lambda>"), (Law(), "Law")]
)
def test_the_name_is_that_of_the_law(law, name):
    with recorded() as decisions:
        pointwise(law)(2.0, jnp.ones(3))
    assert [d.function for d in decisions] == [f"{__name__}.{name}"]


def test_nobody_listens_afterwards():
    with recorded() as decisions:
        note("a.b", "value", None)
    note("a.c", "value", None)
    assert [d.function for d in decisions] == ["a.b"]
