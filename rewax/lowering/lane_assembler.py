"""Assembles programs with one batch element per lane: lists of operations, with loops, become bytecode."""

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rewax.lowering.from_jaxpr import OperationList
from rewax.lowering.instructions import NUMBERS
from rewax.lowering.operations import Loop, Operation, UnsupportedError
from rewax.lowering.selection import NOTHING, Cover, Registers, Step, in_runs, needed_for


class Bytecode(NamedTuple):
    """Bytecode with one batch element per lane."""

    code: np.ndarray
    """Runs: an instruction, its number of repetitions, and its registers for each repetition; int32."""
    constants: np.ndarray
    num_registers: int
    operands: tuple[int, ...]
    """Indices of the arguments that it reads."""


def assemble(listing: OperationList, types: Sequence[Any]) -> Bytecode:
    """Bytecode of a list of operations, with one batch element per lane.

    Args:
      listing: the operations.
      types: types of the arguments.

    Raises:
      UnsupportedError: the program returns integers or booleans, or an operation has no instruction.
    """
    operations, outputs = listing.operations, listing.outputs
    if any(operations[i].kind != "f" for output in outputs for i in output):
        raise UnsupportedError("it returns integers or booleans")
    arguments = {operations[i].constant[0] for i in needed_for(listing, outputs) if operations[i].name == "input"}
    found, registers = in_registers(listing, outputs, types, tuple(sorted(arguments)))
    full = [output for output in outputs if output]
    stores = [("store", (registers[i], k, offset)) for k, output in enumerate(full) for offset, i in enumerate(output)]
    return found._replace(code=np.concatenate([found.code, in_runs(stores)]))


def in_registers(
    listing: OperationList, outputs: Sequence[Sequence[int]], types: Sequence[Any], arguments: tuple[int, ...]
) -> tuple[Bytecode, dict[int, int]]:
    """Bytecode that keeps its results in registers, and the registers of all values.

    Args:
      listing, types: as for ``assemble``.
      outputs: results, by the indices of the operations of their entries.
      arguments: indices of the arguments that it reads.
    """
    operations, needed = listing.operations, needed_for(listing, outputs)
    loops = [loop for loop in (_read_values(loop, {*needed}) for loop in listing.loops) if loop.carried]
    kept = {i for output in outputs for i in output}
    kept |= {i for loop in loops for i in (loop.condition, *loop.initial, *loop.following)}
    steps = Cover(operations, needed, kept, lanes=True).steps()
    read = {o for step in steps for o in step.operands} | kept
    given = [i for i in needed if operations[i].name in ("constant", "input") and i in read]
    constants = {i: k for k, i in enumerate(i for i in given if operations[i].name == "constant")}
    for i in given:
        if i in constants:
            steps.append(Step("constant", i, (), (constants[i],)))
        else:
            argument, offset = operations[i].constant
            steps.append(Step(f"load_{type_name(types[argument])}", i, (), (arguments.index(argument), offset)))
    # After a loop its values lie in the registers in which they were during the loop.
    results = [(i, operations[i].constant) for i in needed if operations[i].name == "result"]
    same = {i: listing.loops[number].carried[k] for i, (number, k) in results}
    steps = _with_loops(operations, steps, loops, same) if loops else sorted(steps, key=lambda step: step.operation)
    registers = Registers(steps, {same.get(i, i) for output in outputs for i in output})
    if loops:
        _keep_through_loops(steps, registers)
    dying: dict[int, list[int]] = defaultdict(list)
    for i, k in registers.last.items():
        dying[k].append(i)
    code = _Code()
    for k, (instruction, i, operands, extra) in enumerate(steps):
        locations = tuple(registers.register[o] for o in operands)
        registers.release(k, dying[k])
        to = () if i == NOTHING else (registers.take(i),)
        code.append(instruction, (*to, *locations, *extra))
    numbers = np.array([_lane(operations[i], listing.dtype) for i in constants], listing.dtype)
    found = registers.register | {i: registers.register[j] for i, j in same.items() if j in registers.register}
    return Bytecode(code.finished(), numbers, registers.count, arguments), found


def type_name(dtype: Any) -> str:
    """Name of an argument's type in the instructions that load it."""
    return "float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name


def _lane(operation: Operation, dtype: np.dtype) -> Any:
    """A constant as a number with the bits of its lane."""
    if operation.kind == "f":
        return dtype.type(float(operation.constant))
    bits = 8 * dtype.itemsize
    integer = -int(operation.constant == "True") if operation.kind == "b" else int(operation.constant)
    return np.array(integer % 2**bits, f"uint{bits}").view(dtype)


# --- Loops ------------------------------------------------------------------------------------------------------------


def _read_values(loop: Loop, needed: set[int]) -> Loop:
    """The loop without the values that nobody reads."""
    read = [k for k, i in enumerate(loop.carried) if i in needed]
    initial, carried, following = (
        tuple(values[k] for k in read) for values in (loop.initial, loop.carried, loop.following)
    )
    return loop._replace(initial=initial, carried=carried, following=following)


def _with_loops(
    operations: Sequence[Operation], steps: Sequence[Step], loops: Sequence[Loop], same: dict[int, int]
) -> list[Step]:
    """All steps in the order of places. ``same`` names the values of loops that lie in the registers of others."""
    placed = [((operations[step.operation].place, step.operation), step) for step in steps]
    placed += [at for loop in loops for at in _loop_steps(operations, loop)]
    placed.sort(key=lambda at: at[0])
    return [step._replace(operands=tuple(same.get(o, o) for o in step.operands)) for _, step in placed]


def _loop_steps(operations: Sequence[Operation], loop: Loop) -> list[tuple[tuple[tuple[float, ...], float], Step]]:
    """The steps of a loop that belong to no operation, and where they are in the order of places."""
    copies = {i: ("copy", "f" if operations[i].kind == "f" else "w") for i in loop.carried}
    moved = {i: new for i, new in zip(loop.carried, loop.following, strict=True) if new != i}
    before, after = loop.place, (*loop.place, math.inf)
    exit_at = (operations[loop.condition].place, loop.condition + 0.5)
    return [
        *(((before, -2), Step(copies[i], i, (old,))) for i, old in zip(loop.carried, loop.initial, strict=True)),
        ((before, -1), Step("loop_begin", NOTHING, ())),
        (exit_at, Step("loop_exit", NOTHING, (loop.condition,))),
        *(((after, 0), Step(copies[i], i, (new,))) for i, new in moved.items()),
        ((after, 1), Step("loop_back", NOTHING, ())),
    ]


def _keep_through_loops(steps: Sequence[Step], registers: Registers) -> None:
    """Values from before a loop that it reads are read again in its next turn."""
    first: dict[int, int] = {}
    for k, step in enumerate(steps):
        if step.operation != NOTHING:
            first.setdefault(step.operation, k)
    begins = []
    for end, step in enumerate(steps):
        if step.instruction == "loop_begin":
            begins.append(end)
        if step.instruction != "loop_back":
            continue
        begin = begins.pop()
        for inner in steps[begin:end]:
            for i in inner.operands:
                if first[i] < begin:
                    registers.last[i] = max(registers.last[i], end)


class _Code:
    """Bytecode with the jumps of loops."""

    def __init__(self) -> None:
        self.parts: list[np.ndarray] = []
        self.rows: list[tuple[Any, tuple[int, ...]]] = []
        self.length = 0
        self.open: list[list[int]] = []
        """For each open loop: where it begins, and the part and place of its exit."""

    def append(self, instruction: Any, locations: tuple[int, ...]) -> None:
        if instruction == "loop_begin":
            self.flush()
            self.open.append([self.length])
        elif instruction == "loop_exit":
            self.flush()
            self.put(NUMBERS["loop_exit"], 1, *locations, 0)
            self.open[-1] += [len(self.parts) - 1, self.length]
        elif instruction == "loop_back":
            self.flush()
            begin, part, after_exit = self.open.pop()
            self.put(NUMBERS["loop_back"], 1, self.length + 2 - begin)
            self.parts[part][-1] = self.length - (after_exit - 2)
        else:
            self.rows.append((instruction, locations))

    def put(self, *numbers: int) -> None:
        self.parts.append(np.array(numbers, np.int32))
        self.length += len(numbers)

    def flush(self) -> None:
        self.put(*in_runs(self.rows).tolist())
        self.rows = []

    def finished(self) -> np.ndarray:
        self.flush()
        return np.concatenate(self.parts)


__all__ = ["Bytecode", "assemble", "in_registers", "type_name"]
