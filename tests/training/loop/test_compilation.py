"""Compiling a train step: the quick generator computes the same, and garbage is collected again afterwards."""

import gc
import io

import jax
import numpy as np
import pytest
import toys
from rich.console import Console

from rewax import xla_options
from rewax.agents.config import RunConfig
from rewax.jax_versions import numbers
from rewax.lowering import machine, report
from rewax.training.loop.compilation import compile_train_step, compiler_options, no_garbage_collection, programs_kept
from rewax.training.loop.devices import Placement

AGENT = toys.make_toy(toys.point_mass())
OTHER = toys.make_toy(toys.point_mass(), noise=0.5)
QUICK = AGENT._replace(config=RunConfig(quick_compile=True))


def test_quick_programs_compute_the_same():
    console = Console(file=io.StringIO())
    assert compiler_options(QUICK) or numbers(jax.__version__) > (0, 10, 2)  # newer XLA has one generator
    assert not compiler_options(AGENT)
    state = AGENT.init(jax.random.key(0))
    quick, thorough = (compile_train_step(agent, state, console) for agent in (QUICK, AGENT))
    for _ in range(3):
        (state, metrics), (other, other_metrics) = quick(state), thorough(state)
        for mine, theirs in zip(jax.tree.leaves(metrics), jax.tree.leaves(other_metrics), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-6)
        state = other


@pytest.mark.parametrize(("in_cpp", "level"), [(True, 1), (False, 3)])
def test_loops_that_xla_compiles_itself_are_optimised(in_cpp, level, monkeypatch):
    monkeypatch.setattr(machine, "why_in_xla", lambda: None if in_cpp else "there is no C++ compiler")
    if xla_options.has_older_generator():
        assert compiler_options(QUICK)["xla_backend_optimization_level"] == level


def test_an_unknown_option_is_not_ignored():
    """Else ``quick_compile`` might do nothing with a jaxlib to come."""
    with pytest.raises(Exception, match="xla_cpu_no_such_option"):
        jax.jit(lambda x: x + 1).lower(1.0).compile({"xla_cpu_no_such_option": False})


def test_an_xla_without_the_older_generator_compiles_and_says_so(monkeypatch):
    monkeypatch.setattr(xla_options, "QUICK", {"xla_cpu_no_such_option": False})
    xla_options.has_older_generator.cache_clear()
    try:
        assert compiler_options(QUICK) == {}
        for agent, said in ((QUICK, True), (AGENT, False)):
            console = Console(file=io.StringIO(), width=200)
            compiled = compile_train_step(agent, AGENT.init(jax.random.key(0)), console)
            assert compiled is not None
            assert (f"quick_compile changes nothing: XLA of jax {jax.__version__}" in console.file.getvalue()) == said
    finally:
        xla_options.has_older_generator.cache_clear()


def test_only_a_cpu_has_the_older_generator(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not compiler_options(QUICK)


@pytest.mark.parametrize("enabled", [True, False])
def test_garbage_is_collected_again(enabled):
    was = gc.isenabled()
    try:
        (gc.enable if enabled else gc.disable)()
        with pytest.raises(RuntimeError, match="while tracing"), no_garbage_collection():
            assert not gc.isenabled()
            raise RuntimeError("while tracing")
        assert gc.isenabled() == enabled
    finally:
        (gc.enable if was else gc.disable)()


def test_an_equal_run_inside_programs_kept_uses_the_compiled_program():
    console, begun = Console(file=io.StringIO(), width=200), []

    def compiled(agent, seed):
        return compile_train_step(
            agent, agent.init(jax.random.key(seed)), console, meanwhile=lambda: begun.append(seed)
        )

    with programs_kept():
        first = compiled(AGENT, 0)
        assert compiled(AGENT, 1) is first and begun == [0, 1]
        other = compiled(OTHER, 2)
        assert other is not first and compiled(OTHER, 3) is other
        assert compiled(AGENT, 4) is not first  # only the last one is kept
    assert compiled(AGENT, 5) is not compiled(AGENT, 6)
    assert console.file.getvalue().count("compiling train_step") == 5


def test_a_kept_program_says_again_what_runs_in_cpp(monkeypatch):
    def lowered(self, train_step, train_state, *, donate):
        report.note("a.function", "value", None)
        return jax.jit(train_step).lower(train_state)

    monkeypatch.setattr(Placement, "lowered", lowered)
    state = AGENT.init(jax.random.key(0))
    with programs_kept():
        for _ in range(2):
            with report.recorded() as decisions:
                compile_train_step(AGENT, state, Console(file=io.StringIO()))
            assert [decision.function for decision in decisions] == ["a.function"]
