"""Pointwise functions of tasks on a CPU: the machine beside XLA, and the instructions that their programs consist of.

python benchmarks/lowering.py                              # microseconds of each program, by the machine and by XLA
python benchmarks/lowering.py --tasks GripperLift --mine   # also which instructions there are, and which would pay
"""

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.lowering import kernels
from rewax.lowering.instructions import Expression
from rewax.lowering.recompute import RECOMPUTED, Program
from rewax.lowering.selection import Cover


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    tasks: tuple[str, ...] = ("RollingFlat", "HandFlip", "GripperLift")
    count: int = 4096
    """Elements of each program."""
    seconds: float = 1.0
    """How long each program is repeated; the best time counts."""
    mine: bool = False
    """Count instructions, and pairs of them of which one alone reads what the other computes."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One program: value or derivative of a pointwise function."""

    which: str
    program: Program
    avals: tuple[tuple[tuple[int, ...], Any, bool], ...]
    varies: tuple[bool, ...]

    @property
    def name(self) -> str:
        function = self.program.function.__closure__[0].cell_contents  # type: ignore[index]
        return f"{self.which} of {function.__name__}"

    def arguments(self, count: int) -> list[jax.Array]:
        draw = np.random.default_rng(0)
        found = []
        for (shape, dtype, _), varies in zip(self.avals, self.varies, strict=True):
            full = (*shape[:-1], count) if varies else shape
            real = jnp.issubdtype(dtype, jnp.floating)
            found.append(jnp.asarray(draw.uniform(0.5, 1.5, full) if real else draw.integers(0, 2, full), dtype))
        return found

    def run(self, rule: Callable[..., Any]) -> Callable[..., Any]:
        first = len(self.program.varies)
        return jax.jit(lambda *args: rule(self.program, args[:first], args[first:]))


def cases_of(task: str) -> list[Case]:
    """The programs of a task's step and of its gradient."""
    found: dict[Case, None] = {}
    target = kernels.target_of

    def record(which: str, program: Program, avals: tuple, varies: tuple[bool, ...], precision: Any) -> Any:
        found[Case(which, program, avals, varies)] = None
        return target(which, program, avals, varies, precision)

    kernels.target_of = record  # type: ignore[assignment]
    try:
        env: Any = rewax.make(task, scale="paper")
        state = jax.eval_shape(env.reset, jax.random.key(0))
        jax.jit(jax.grad(lambda a, s: env.step(s, a).reward)).lower(jnp.zeros(env.action_spec.shape), state)
    finally:
        kernels.target_of = target
    return list(found)


def best_of(functions: list[Callable[[], Any]], seconds: float) -> list[float]:
    """The least seconds of each, in turns."""
    best = [math.inf] * len(functions)
    for function in functions:
        jax.block_until_ready(function())
    end = time.perf_counter() + seconds * len(functions)
    while time.perf_counter() < end:
        for k, function in enumerate(functions):
            began = time.perf_counter()
            jax.block_until_ready(function())
            best[k] = min(best[k], time.perf_counter() - began)
    return best


def text(expression: Expression) -> str:
    return expression if isinstance(expression, str) else f"{expression[0]}({', '.join(map(text, expression[1:]))})"


def mine(cases: list[Case]) -> None:
    used, pairs = Counter(), Counter()
    steps_of = Cover.steps

    def record(cover: Cover) -> list[Any]:
        steps = steps_of(cover)
        by_operation = {step.operation: step for step in steps}
        users = Counter(o for step in steps for o in step.operands)
        if not cover.lanes:
            used.update(text(step.instruction) for step in steps)
            inner = [(s, by_operation[o]) for s in steps for o in s.operands if o in by_operation and users[o] == 1]
            pairs.update(f"{text(s.instruction)} of {text(o.instruction)}" for s, o in inner)
        return steps

    Cover.steps = record  # type: ignore[method-assign]
    try:
        for case in cases:
            kernels.bytecode_of(case.which, case.program, case.avals, case.varies)
    finally:
        Cover.steps = steps_of
    for title, counted in (("instructions", used), ("pairs that could be one instruction", pairs)):
        print(f"\n{title}:")
        for name, times in counted.most_common(40):
            print(f"{times:6d}  {name}")


def main(args: Args) -> None:
    cases = []
    print(f"{'':50s} {'machine':>10s} {'XLA':>10s} {'XLA / machine':>15s}   registers")
    for task in args.tasks:
        for case in cases_of(task):
            if case in cases:
                continue
            cases.append(case)
            inputs = case.arguments(args.count)
            machine, xla = (
                case.run(rule)
                for rule in (lambda *a, c=case: kernels._run(c.which, *a), getattr(RECOMPUTED, case.which))
            )
            fast, slow = best_of([lambda f=f, x=inputs: f(*x) for f in (machine, xla)], args.seconds)
            program, *_ = kernels.bytecode_of(case.which, case.program, case.avals, case.varies)
            print(
                f"{task} {case.name:{49 - len(task)}s} {1e6 * fast:7.0f} us {1e6 * slow:7.0f} us {slow / fast:13.1f} x "
                f"{program.num_registers:11d}",
                flush=True,
            )
    if args.mine:
        mine(cases)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
