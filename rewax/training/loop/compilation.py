"""Ahead-of-time compilation of ``train_step``, and its compiler options."""

import contextlib
import gc
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
from rich.console import Console

from rewax import xla_options
from rewax.agents.base import Agent
from rewax.training.loop.devices import ONE_DEVICE, Placement
from rewax.training.loop.progress import say


def compile_train_step(
    agent: Agent,
    train_state: Any,
    console: Console,
    where: Placement = ONE_DEVICE,
    meanwhile: Callable[[], None] = lambda: None,
) -> Any:
    """Compile ``agent.train_step`` ahead of the first iteration, telling the user how long it takes.

    On a CPU the agent's ``config.quick_compile`` chooses the code generator, see ``RunConfig``. ``meanwhile`` is called
    after tracing and before compiling: while XLA compiles, it does not hold Python's global lock, so a thread that
    ``meanwhile`` starts can trace other programs.

    Returns:
      The compiled function; it never traces again.
    """
    without = _wants_quick(agent) and not xla_options.has_older_generator()
    note = f" (quick_compile changes nothing: XLA of jax {jax.__version__} has no older generator)" if without else ""
    say(console, f"compiling train_step ...{note}")
    began = time.perf_counter()
    with no_garbage_collection():
        lowered = where.lowered(agent.train_step, train_state, donate=agent.consumes)
        meanwhile()
        compiled = lowered.compile(compiler_options(agent))
    sharded = f", environments on {where.num_devices} devices" if where.shards(train_state) else ""
    say(console, f"compiled in {time.perf_counter() - began:.1f} s{sharded}")
    return compiled


def compiler_options(agent: Agent) -> dict[str, Any]:
    """XLA's compiler options for the agent's programs."""
    return xla_options.QUICK if _wants_quick(agent) and xla_options.has_older_generator() else {}


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


__all__ = ["compile_train_step", "compiler_options", "no_garbage_collection"]
