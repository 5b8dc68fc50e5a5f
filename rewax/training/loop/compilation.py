"""Ahead-of-time compilation of ``train_step``, its compiler options, and compiled programs kept from run to run."""

import contextlib
import gc
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, TypeVar

import jax
from rich.console import Console

from rewax import xla_options
from rewax.agents.base import Agent
from rewax.lowering import machine, report
from rewax.training.loop.devices import ONE_DEVICE, Placement
from rewax.training.loop.progress import say

T = TypeVar("T")

_kept: ContextVar[dict[str, tuple[Any, Any]] | None] = ContextVar("kept", default=None)


@contextlib.contextmanager
def programs_kept() -> Iterator[None]:
    """Inside, a run with the algorithm, options and environment of the run before uses its compiled programs."""
    token = _kept.set({})
    try:
        yield
    finally:
        _kept.reset(token)


def kept(what: str, key: Any, make: Callable[[], T]) -> tuple[T, bool]:
    """``make()`` and False, or inside ``programs_kept`` the last one of the same name and True, if its key is equal."""
    store = _kept.get()
    if store is None:
        return make(), False
    if what in store and store[what][0] == key:
        return store[what][1], True
    store.pop(what, None)  # its memory is free before the next program is made
    store[what] = key, make()
    return store[what][1], False


def compile_train_step(
    agent: Agent,
    train_state: Any,
    console: Console,
    where: Placement = ONE_DEVICE,
    meanwhile: Callable[[], None] = lambda: None,
) -> Any:
    """Compile ``agent.train_step`` ahead of the first iteration, telling the user how long it takes.

    On a CPU the agent's ``config.quick_compile`` chooses the code generator, see ``RunConfig``.

    Args:
      agent: its ``train_step`` is compiled.
      train_state: a state of the run; only shapes and types are used.
      console: to print to.
      where: the devices of the run.
      meanwhile: called after tracing and before compiling. XLA compiles without Python's global lock, so a thread that
        it starts can trace other programs.

    Returns:
      The compiled function; it never traces again.
    """

    def compiled() -> tuple[Any, list[report.Decision]]:
        without = _wants_quick(agent) and not xla_options.has_older_generator()
        why = (
            f" (quick_compile changes nothing: XLA of jax {jax.__version__} has no older generator)" if without else ""
        )
        say(console, f"compiling train_step ...{why}")
        began = time.perf_counter()
        with no_garbage_collection(), report.recorded() as told:
            lowered = where.lowered(agent.train_step, train_state, donate=agent.consumes)
            meanwhile()
            program = lowered.compile(compiler_options(agent))
        sharded = f", {where.what} on {where.num_devices} devices" if where.shards(train_state) else ""
        say(console, f"compiled in {time.perf_counter() - began:.1f} s{sharded}")
        return program, told

    leaves, structure = jax.tree.flatten(train_state)
    shapes = tuple((jax.typeof(leaf), getattr(leaf, "sharding", None)) for leaf in leaves)
    key = (agent.train_step, structure, shapes, where, agent.consumes, compiler_options(agent))
    (program, decisions), again = kept("train_step", key, compiled)
    if again:
        for decision in decisions:
            report.note(*decision)
        meanwhile()
    return program


def compiler_options(agent: Agent) -> dict[str, Any]:
    """XLA's compiler options for the agent's programs."""
    if not (_wants_quick(agent) and xla_options.has_older_generator()):
        return {}
    return xla_options.QUICK if machine.why_in_xla() is None else xla_options.QUICK_IN_XLA


def _wants_quick(agent: Agent) -> bool:
    return getattr(agent.config, "quick_compile", False) and jax.default_backend() == "cpu"


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Switches garbage collection off: tracing allocates millions of objects that stay alive, and searching them for
    cycles takes a fifth of its time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


__all__ = ["compile_train_step", "compiler_options", "kept", "no_garbage_collection", "programs_kept"]
