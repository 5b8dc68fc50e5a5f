"""Chooses the machine's instructions for lists of operations, and allocates registers.

Operations with one consumer each form trees. Dynamic programming covers a tree with as few instructions as possible
(Aho, Lam, Sethi, Ullman, Compilers, section 8.11). Registers are reused after the last read of their value.
"""

import functools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rewax.lowering.from_jaxpr import OperationList
from rewax.lowering.instructions import BY_NAME, COMMUTATIVE, INSTRUCTIONS, NUMBERS, Expression
from rewax.lowering.operations import Operation, UnsupportedError

NOTHING = -1
"""The operation of a step that computes no value."""


class Step(NamedTuple):
    """An instruction, the operation that it computes and the operations that it reads."""

    instruction: Expression
    operation: int
    """``NOTHING``: the step only changes what is computed next."""
    operands: tuple[int, ...]
    extra: tuple[int, ...] = ()


def needed_for(listing: OperationList, outputs: Sequence[Sequence[int]]) -> list[int]:
    """Indices of the operations that the outputs depend on, in order."""
    needed, rest = set(), [i for output in outputs for i in output]
    while rest:
        i = rest.pop()
        if i in needed:
            continue
        needed.add(i)
        operation = listing.operations[i]
        rest += operation.operands
        if operation.name in ("carry", "result"):
            loop, k = listing.loops[operation.constant[0]], operation.constant[1]
            rest += [loop.condition, loop.initial[k], loop.carried[k], loop.following[k]]
    return sorted(needed)


@functools.cache
def _candidates(name: str, operands: tuple[tuple[str, str], ...], lanes: bool) -> tuple[int, ...]:
    """Instructions whose last operation is ``name`` and whose parts fit operands of these (kind, inner operation)."""

    def fits(part: Expression, operand: tuple[str, str]) -> bool:
        return _is(part, operand[0], lanes) if isinstance(part, str) else part[0] == operand[1]

    def found(parts: tuple[Expression, ...]) -> bool:
        return any(all(map(fits, parts, order)) for order in _orders(name, operands))

    return tuple(number for number in BY_NAME[name] if found(INSTRUCTIONS[number].expression[1:]))  # pyright: ignore[reportArgumentType]


def _is(kind: str, given: str, lanes: bool) -> bool:
    """Whether an operand of a kind fits an instruction. In lanes, constants are vectors too."""
    return kind == given or (lanes and kind == given.lower())


def _orders(name: str, operands: tuple) -> tuple[tuple, ...]:
    return (operands, operands[::-1]) if name in COMMUTATIVE else (operands,)


class Cover:
    """Covers the operations of a program with instructions."""

    def __init__(self, operations: Sequence[Operation], chosen: Sequence[int], kept: set[int], lanes: bool) -> None:
        """``chosen``: operations to compute, in order; ``kept``: operations whose values are results."""
        self.operations, self.lanes = operations, lanes
        users = Counter(o for i in chosen for o in operations[i].operands)
        self.inner = {i for i in chosen if users[i] == 1 and i not in kept and operations[i].operands}
        if any(operations[i].place for i in chosen):  # what is computed before a loop is no part of it
            at = {o: operations[i].place for i in chosen for o in operations[i].operands}
            self.inner = {i for i in self.inner if operations[i].place == at[i]}
        self.kinds: dict[int, str] = {}
        for i in {*chosen, *users}:
            kind, shared = "f" if operations[i].kind == "f" else "w", operations[i].shared
            self.kinds[i] = kind.upper() if (operations[i].name == "constant" if lanes else shared) else kind
        self.best: dict[int, tuple[int, int, tuple[int, ...]]] = {}
        for i in chosen:
            if operations[i].operands:
                self.best[i] = self.cheapest(i)

    def steps(self) -> list[Step]:
        found, wanted = {}, [i for i in self.best if i not in self.inner]
        while wanted:
            i = wanted.pop()
            _, number, leaves = self.best[i]
            found[i] = Step(INSTRUCTIONS[number].expression, i, leaves)
            wanted += [o for o in leaves if o in self.inner]
        return [found[i] for i in sorted(found)]

    def cheapest(self, i: int) -> tuple[int, int, tuple[int, ...]]:
        """Cost, index and operands of the cheapest instruction whose last operation is ``i``."""
        name, operands = self.operations[i].name, self.operations[i].operands
        given = tuple((self.kinds[o], self.operations[o].name if o in self.inner else "") for o in operands)
        found = []
        for number in _candidates(name, given, self.lanes):
            leaves = self.matched(INSTRUCTIONS[number].expression, i)  # pyright: ignore[reportArgumentType]
            if leaves is not None:
                cost = 2 + len(leaves) + sum(self.best[o][0] for o in leaves if o in self.inner)
                found.append((cost, number, leaves))
        if not found:
            raise UnsupportedError(f"it has the operation {name} of operands of other types")
        return min(found)

    def matched(self, expression: tuple, i: int) -> tuple[int, ...] | None:
        """The operands of an expression that matches the tree of operation ``i``; None if it does not match."""
        name, *parts = expression
        if self.operations[i].name != name:
            return None
        for operands in _orders(name, self.operations[i].operands):
            leaves: list[int] = []
            for part, o in zip(parts, operands, strict=True):
                if isinstance(part, str):
                    found = (o,) if _is(part, self.kinds[o], self.lanes) else None
                else:
                    found = self.matched(part, o) if o in self.inner else None
                if found is None:
                    break
                leaves += found
            else:
                return tuple(leaves)
        return None


class Registers:
    """Allocates registers and reuses those of dead values."""

    def __init__(self, steps: Sequence[Step], kept: set[int]) -> None:
        self.register: dict[int, int] = {}
        self.count = 0
        self.free: list[int] = []
        self.last = {o: k for k, s in enumerate(steps) for o in (s.operation, *s.operands) if o != NOTHING}
        self.last |= dict.fromkeys(kept, len(steps))

    def release(self, k: int, values: Iterable[int]) -> None:
        """Frees the registers of values whose last read is step ``k``."""
        self.free += [self.register[i] for i in dict.fromkeys(values) if self.last[i] == k and i in self.register]

    def take(self, i: int) -> int:
        """The register of a value, by default a free one."""
        if i in self.register:
            return self.register[i]
        if not self.free:
            self.free.append(self.count)
            self.count += 1
        self.register[i] = self.free.pop()
        return self.register[i]


def in_runs(rows: Sequence[tuple[Expression, tuple[int, ...]]]) -> np.ndarray:
    code: list[int] = []
    begin = 0
    for k, (instruction, locations) in enumerate(rows):
        if k == 0 or rows[k - 1][0] != instruction:
            begin = len(code) + 1
            code += [NUMBERS[instruction], 0]
        code[begin] += 1
        code += locations
    return np.array(code, np.int32)


__all__ = ["NOTHING", "Cover", "Registers", "Step", "in_runs", "needed_for"]
