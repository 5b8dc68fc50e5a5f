"""Assembles lists of operations to bytecode for the machine: instructions chosen, registers given.

Operations with one user each form trees. A tree is covered by as few and as large instructions as possible (instruction
selection by dynamic programming over trees: Aho, Lam, Sethi, Ullman, Compilers, 8.11). The register of a value that
nobody needs any more is used again.
"""

import functools
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rewax.lowering.from_jaxpr import OperationList
from rewax.lowering.instructions import BY_NAME, COMMUTATIVE, INSTRUCTIONS, NUMBERS, Expression
from rewax.lowering.operations import Operation, UnsupportedError


class Bytecode(NamedTuple):
    """A program with one batch element in each lane."""

    code: np.ndarray
    """Runs: an instruction, how often, and the registers of each time; int32."""
    constants: np.ndarray
    num_registers: int
    operands: tuple[int, ...]
    """Which arguments it reads."""


class BlockBytecode(NamedTuple):
    """A pointwise program."""

    shared: Bytecode
    """What all elements share, computed once for each batch element."""
    code: np.ndarray
    """The rest. It finds its operands by these numbers: registers, then shared values, inputs and outputs."""
    num_registers: int
    num_sums: int
    shared_registers: tuple[int, ...]
    """Where the shared program leaves the values that the rest reads."""
    inputs: tuple[tuple[int, int, int, int], ...]
    """Which argument, which of its rows, how many rows it has, bytes of a number."""
    outputs: tuple[tuple[int, int, int, int], ...]
    """The same for those results that are not summed."""

    @property
    def layout(self) -> np.ndarray:
        """All but the code, as ``rewax_add_program`` reads it."""
        rows = [number for row in (*self.inputs, *self.outputs) for number in row]
        counts = (len(self.shared_registers), len(self.inputs), len(self.outputs))
        head = (self.shared.num_registers, self.num_registers, self.num_sums, *counts)
        return np.array([*head, *self.shared_registers, *rows], np.int32)


class _Step(NamedTuple):
    """An instruction, the operation that it completes and those that it reads."""

    instruction: Expression
    operation: int
    operands: tuple[int, ...]
    extra: tuple[int, ...] = ()


def assemble(line: OperationList, types: Sequence[Any]) -> Bytecode:
    """The program of a list of operations, for batch elements side by side.

    Args:
      line: the operations.
      types: of its arguments.

    Raises:
      UnsupportedError: it returns integers or booleans, or there is no instruction for an operation.
    """
    operations, outputs = line.operations, line.outputs
    if any(operations[i].kind != "f" for output in outputs for i in output):
        raise UnsupportedError("it returns integers or booleans")
    arguments = {operations[i].constant[0] for i in _needed(operations, outputs) if operations[i].name == "input"}
    found, registers = _of_lanes(line, outputs, types, tuple(sorted(arguments)))
    full = [output for output in outputs if output]
    stores = [("store", (registers[i], k, offset)) for k, output in enumerate(full) for offset, i in enumerate(output)]
    return found._replace(code=np.concatenate([found.code, _in_runs(stores)]))


def assemble_blocks(
    line: OperationList, types: Sequence[Any], rows: Sequence[int], summed: Sequence[bool]
) -> BlockBytecode:
    """The program of a list of operations, for many elements in each batch element.

    Args:
      line: the operations.
      types: of its arguments.
      rows: how many numbers of an element each argument has.
      summed: which of the results are sums over all elements.

    Raises:
      UnsupportedError: it returns integers, or there is no instruction for an operation.
    """
    operations = line.operations
    if any(operations[i].kind in ("i", "l", "u") for output in line.outputs for i in output):
        raise UnsupportedError("it returns integers")
    own = [output for output, total in zip(line.outputs, summed, strict=True) if not total]
    sums = [i for output, total in zip(line.outputs, summed, strict=True) if total for i in output]
    return _Blocks(line, types, rows, own, sums).assembled()


# --- Instruction selection --------------------------------------------------------------------------------------------


def _needed(operations: Sequence[Operation], outputs: Sequence[Sequence[int]]) -> list[int]:
    """Operations that the outputs need, in order."""
    needed, rest = set(), [i for output in outputs for i in output]
    while rest:
        i = rest.pop()
        if i not in needed:
            needed.add(i)
            rest += operations[i].operands
    return sorted(needed)


@functools.cache
def _candidates(name: str, operands: tuple[tuple[str, str], ...], lanes: bool) -> tuple[int, ...]:
    """Instructions that end with an operation of operands of these kinds, which these operations alone compute."""

    def fits(part: Expression, operand: tuple[str, str]) -> bool:
        return _is(part, operand[0], lanes) if isinstance(part, str) else part[0] == operand[1]

    def found(parts: tuple[Expression, ...]) -> bool:
        return any(all(map(fits, parts, order)) for order in _orders(name, operands))

    return tuple(number for number in BY_NAME[name] if found(INSTRUCTIONS[number].expression[1:]))  # pyright: ignore[reportArgumentType]


def _is(kind: str, given: str, lanes: bool) -> bool:
    """Whether an operand fits an instruction. In lanes constants are vectors, too."""
    return kind == given or (lanes and kind == given.lower())


def _orders(name: str, operands: tuple) -> tuple[tuple, ...]:
    return (operands, operands[::-1]) if name in COMMUTATIVE else (operands,)


class _Cover:
    """Instructions that compute the operations of a program."""

    def __init__(self, operations: Sequence[Operation], chosen: Sequence[int], kept: set[int], lanes: bool) -> None:
        """``chosen`` are to be computed, in this order; values of ``kept`` are results."""
        self.operations, self.lanes = operations, lanes
        users = Counter(o for i in chosen for o in operations[i].operands)
        self.inner = {i for i in chosen if users[i] == 1 and i not in kept and operations[i].operands}
        self.kinds: dict[int, str] = {}
        for i in {*chosen, *users}:
            kind, shared = "f" if operations[i].kind == "f" else "w", operations[i].shared
            self.kinds[i] = kind.upper() if (operations[i].name == "constant" if lanes else shared) else kind
        self.best: dict[int, tuple[int, int, tuple[int, ...]]] = {}
        for i in chosen:
            if operations[i].operands:
                self.best[i] = self.cheapest(i)

    def steps(self) -> list[_Step]:
        found, wanted = {}, [i for i in self.best if i not in self.inner]
        while wanted:
            i = wanted.pop()
            _, number, leaves = self.best[i]
            found[i] = _Step(INSTRUCTIONS[number].expression, i, leaves)
            wanted += [o for o in leaves if o in self.inner]
        return [found[i] for i in sorted(found)]

    def cheapest(self, i: int) -> tuple[int, int, tuple[int, ...]]:
        """Cost, number and operands of the best instruction whose last operation is ``i``."""
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
        """The operands of an expression whose last operation is ``i``; None if it is another expression."""
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


class _Registers:
    """Registers of values. The register of a value that is no longer needed is used again."""

    def __init__(self, steps: Sequence[_Step], kept: set[int]) -> None:
        self.place: dict[int, int] = {}
        self.count = 0
        self.free: list[int] = []
        self.last = {o: k for k, step in enumerate(steps) for o in (step.operation, *step.operands)}
        self.last |= dict.fromkeys(kept, len(steps))

    def release(self, k: int, values: Sequence[int]) -> None:
        """Frees the registers of values that step ``k`` is the last one to need."""
        self.free += [self.place[i] for i in dict.fromkeys(values) if self.last[i] == k and i in self.place]

    def take(self, i: int) -> int:
        if not self.free:
            self.free.append(self.count)
            self.count += 1
        self.place[i] = self.free.pop()
        return self.place[i]


def _in_runs(rows: Sequence[tuple[Expression, tuple[int, ...]]]) -> np.ndarray:
    code: list[int] = []
    begin = 0
    for k, (instruction, places) in enumerate(rows):
        if k == 0 or rows[k - 1][0] != instruction:
            begin = len(code) + 1
            code += [NUMBERS[instruction], 0]
        code[begin] += 1
        code += places
    return np.array(code, np.int32)


# --- Batch elements in lanes ------------------------------------------------------------------------------------------


def _of_lanes(
    line: OperationList, outputs: Sequence[Sequence[int]], types: Sequence[Any], arguments: tuple[int, ...]
) -> tuple[Bytecode, dict[int, int]]:
    """A program that leaves its results in registers, and these registers."""
    operations, kept = line.operations, {i for output in outputs for i in output}
    needed = _needed(operations, outputs)
    computed = _Cover(operations, needed, kept, lanes=True).steps()
    read = {o for step in computed for o in step.operands} | kept
    given = [i for i in needed if not operations[i].operands and i in read]
    constants = {i: k for k, i in enumerate(i for i in given if operations[i].name == "constant")}
    steps = [*computed]
    for i in given:
        if i in constants:
            steps.append(_Step("constant", i, (), (constants[i],)))
        else:
            argument, offset = operations[i].constant
            name = _type_name(types[argument])
            steps.append(_Step(f"load_{name}", i, (), (arguments.index(argument), offset)))
    steps.sort(key=lambda step: step.operation)
    registers, rows = _Registers(steps, kept), []
    for k, (instruction, i, operands, extra) in enumerate(steps):
        places = tuple(registers.place[o] for o in operands)
        registers.release(k, operands)
        rows.append((instruction, (registers.take(i), *places, *extra)))
    numbers = np.array([_lane(operations[i], line.dtype) for i in constants], line.dtype)
    return Bytecode(_in_runs(rows), numbers, registers.count, arguments), registers.place


def _type_name(dtype: Any) -> str:
    return "float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name


def _lane(operation: Operation, dtype: np.dtype) -> Any:
    """A constant as the number whose bits the machine finds in a lane."""
    if operation.kind == "f":
        return dtype.type(float(operation.constant))
    bits = 8 * dtype.itemsize
    whole = -int(operation.constant == "True") if operation.kind == "b" else int(operation.constant)
    return np.array(whole % 2**bits, f"uint{bits}").view(dtype)


# --- Elements in blocks -----------------------------------------------------------------------------------------------


class _Blocks:
    """Assembles a pointwise program. A place is a kind of memory (register, shared, input, output) and an index."""

    def __init__(
        self, line: OperationList, types: Sequence[Any], rows: Sequence[int], own: list[list[int]], sums: list[int]
    ) -> None:
        self.line, self.types, self.rows, self.own, self.sums = line, types, rows, own, sums
        self.operations = line.operations
        self.needed = _needed(self.operations, [*own, sums])
        self.inputs = [i for i in self.needed if self.operations[i].name == "input" and not self.operations[i].shared]
        self.places: dict[int, tuple[str, int]] = {}
        self.code: list[tuple[Expression, tuple[Any, ...]]] = []

    def assembled(self) -> BlockBytecode:
        operations, products = self.operations, self.summed_products()
        kept = {i for output in self.own for i in output} | set(self.sums) | {o for p in products for o in p.operands}
        varying = [i for i in self.needed if not operations[i].shared and all(i != p.operation for p in products)]
        steps = [_Step(self.conversion(i), i, ()) for i in self.inputs if operations[i].kind != "f"]
        steps += [*products, *_Cover(operations, varying, kept, lanes=False).steps()]
        steps.sort(key=lambda step: step.operation)
        shared = sorted(
            {o for s in steps for o in s.operands if operations[o].shared} | {i for i in kept if operations[i].shared}
        )
        program, registers = _of_lanes(self.line, [shared], self.types, tuple(range(len(self.types))))
        self.places |= {i: ("shared", k) for k, i in enumerate(shared)}
        self.places |= {i: ("input", k) for k, i in enumerate(self.inputs) if operations[i].kind == "f"}
        num_registers = self.place_steps(steps)
        begin = {"register": 0, "shared": num_registers, "input": num_registers + len(shared)}
        begin |= {"output": begin["input"] + len(self.inputs), "number": 0}
        rows = [(name, tuple(begin[kind] + k for kind, k in places)) for name, places in self.code]
        outputs = [
            (k, c, len(output), self.bytes(i)) for k, output in enumerate(self.own) for c, i in enumerate(output)
        ]
        return BlockBytecode(
            program, _in_runs(rows), num_registers, len(self.sums), tuple(registers[i] for i in shared),
            tuple((*operations[i].constant, self.rows[operations[i].constant[0]], self.bytes(i)) for i in self.inputs),
            tuple(outputs),
        )  # fmt: skip

    def summed_products(self) -> list[_Step]:
        """Products that nothing but one sum needs."""
        operations = self.operations
        users = Counter(o for i in self.needed for o in operations[i].operands)
        users.update([i for output in (*self.own, self.sums) for i in output])
        products = [i for i in self.sums if users[i] == 1 and operations[i].name == "mul"]
        varying = [i for i in products if not any(operations[o].shared for o in operations[i].operands)]
        return [_Step("sum_of_products", i, operations[i].operands) for i in varying]

    def place_steps(self, steps: Sequence[_Step]) -> int:
        """Writes the code, and returns the number of registers."""
        operations, registers = self.operations, _Registers(steps, set())
        wanted: dict[int, list[int]] = defaultdict(list)
        for k, i in enumerate(i for output in self.own for i in output):
            wanted[i].append(k)
        sums: dict[int, list[int]] = defaultdict(list)
        for k, i in enumerate(self.sums):
            sums[i].append(k)
        for k, (instruction, i, operands, _) in enumerate(steps):
            places = tuple(self.places[o] for o in operands)
            registers.release(k, operands)
            if instruction == "sum_of_products":
                self.code.append((instruction, (("number", sums.pop(i)[0]), *places)))
                continue
            if wanted[i] and operations[i].kind == "f":
                self.places[i] = ("output", wanted[i].pop(0))
            else:
                self.places[i] = ("register", registers.take(i))
            if operations[i].name == "input":
                places = (("input", self.inputs.index(i)),)
            self.code.append((instruction, (self.places[i], *places)))
            self.deliver(i, wanted.pop(i), sums.pop(i, []))
            registers.release(k, [i])
        temporary = registers.count
        for i in {**wanted, **sums}:  # inputs, and what all elements share
            kind = "f" if operations[i].kind == "f" else "w"
            if operations[i].shared:
                self.code.append((("copy", kind.upper()), (("register", temporary), self.places[i])))
                self.places[i] = ("register", temporary)
            self.deliver(i, wanted.get(i, []), sums.get(i, []))
        return temporary + 1

    def deliver(self, i: int, outputs: list[int], sums: list[int]) -> None:
        """Results that are a value that is already computed."""
        instruction = ("copy", "f") if self.operations[i].kind == "f" else "store_bool"
        self.code += [(instruction, (("output", k), self.places[i])) for k in outputs]
        self.code += [("sum", (("number", k), self.places[i])) for k in sums]

    def conversion(self, i: int) -> str:
        return f"convert_{_type_name(self.types[self.operations[i].constant[0]])}"

    def bytes(self, i: int) -> int:
        operation = self.operations[i]
        if operation.name == "input" and not operation.shared and i in self.inputs:
            return np.dtype(self.types[operation.constant[0]]).itemsize
        return 1 if operation.kind == "b" else self.line.dtype.itemsize


__all__ = ["BlockBytecode", "Bytecode", "assemble", "assemble_blocks"]
