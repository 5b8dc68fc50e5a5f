"""Assembles lists of operations into bytecode for the machine: instruction selection and register allocation.

Operations with one consumer each form trees. Dynamic programming covers a tree with as few instructions as possible
(Aho, Lam, Sethi, Ullman, Compilers, section 8.11). Registers are reused after the last read of their value.
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
    """Bytecode with one batch element per lane."""

    code: np.ndarray
    """Runs: an instruction, its number of repetitions, and its registers for each repetition; int32."""
    constants: np.ndarray
    num_registers: int
    operands: tuple[int, ...]
    """Indices of the arguments that it reads."""


class BlockBytecode(NamedTuple):
    """Bytecode of a pointwise program."""

    shared: Bytecode
    """Computes the values that all elements share, once per batch element."""
    code: np.ndarray
    """Computes the rest. Its operands are numbered: registers first, then shared values, inputs and outputs."""
    num_registers: int
    num_sums: int
    shared_registers: tuple[int, ...]
    """Registers of the shared program with the values that the rest reads."""
    inputs: tuple[tuple[int, int, int, int], ...]
    """For each input: index of the argument, index of the row, number of rows, bytes per number."""
    outputs: tuple[tuple[int, int, int, int], ...]
    """The same for each row of the results that are not summed."""
    operands: tuple[int, ...]
    """Indices of the arguments that it reads; the indices of ``inputs`` and of ``shared`` count these alone."""

    @property
    def layout(self) -> np.ndarray:
        """All fields except the code, in the layout of ``rewax_add_program``."""
        rows = [number for row in (*self.inputs, *self.outputs) for number in row]
        counts = (len(self.shared_registers), len(self.inputs), len(self.outputs))
        head = (self.shared.num_registers, self.num_registers, self.num_sums, *counts)
        return np.array([*head, *self.shared_registers, *rows], np.int32)


class _Step(NamedTuple):
    """An instruction, the operation that it computes and the operations that it reads."""

    instruction: Expression
    operation: int
    operands: tuple[int, ...]
    extra: tuple[int, ...] = ()


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
    arguments = {operations[i].constant[0] for i in _needed(operations, outputs) if operations[i].name == "input"}
    found, registers = _lane_bytecode(listing, outputs, types, tuple(sorted(arguments)))
    full = [output for output in outputs if output]
    stores = [("store", (registers[i], k, offset)) for k, output in enumerate(full) for offset, i in enumerate(output)]
    return found._replace(code=np.concatenate([found.code, _in_runs(stores)]))


def assemble_blocks(
    listing: OperationList, types: Sequence[Any], rows: Sequence[int], summed: Sequence[bool]
) -> BlockBytecode:
    """Bytecode of a list of operations, for many elements per batch element.

    Args:
      listing: the operations.
      types: types of the arguments.
      rows: number of values per element of each argument.
      summed: which of the results are sums over all elements.

    Raises:
      UnsupportedError: the program returns integers, or an operation has no instruction.
    """
    operations = listing.operations
    if any(operations[i].kind in ("i", "l", "u") for output in listing.outputs for i in output):
        raise UnsupportedError("it returns integers")
    own = [output for output, total in zip(listing.outputs, summed, strict=True) if not total]
    sums = [i for output, total in zip(listing.outputs, summed, strict=True) if total for i in output]
    return _Blocks(listing, types, rows, own, sums).assembled()


# --- Instruction selection --------------------------------------------------------------------------------------------


def _needed(operations: Sequence[Operation], outputs: Sequence[Sequence[int]]) -> list[int]:
    """Indices of the operations that the outputs depend on, in order."""
    needed, rest = set(), [i for output in outputs for i in output]
    while rest:
        i = rest.pop()
        if i not in needed:
            needed.add(i)
            rest += operations[i].operands
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


class _Cover:
    """Covers the operations of a program with instructions."""

    def __init__(self, operations: Sequence[Operation], chosen: Sequence[int], kept: set[int], lanes: bool) -> None:
        """``chosen``: operations to compute, in order; ``kept``: operations whose values are results."""
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


class _Registers:
    """Allocates registers and reuses those of dead values."""

    def __init__(self, steps: Sequence[_Step], kept: set[int]) -> None:
        self.register: dict[int, int] = {}
        self.count = 0
        self.free: list[int] = []
        self.last = {o: k for k, step in enumerate(steps) for o in (step.operation, *step.operands)}
        self.last |= dict.fromkeys(kept, len(steps))

    def release(self, k: int, values: Sequence[int]) -> None:
        """Frees the registers of values whose last read is step ``k``."""
        self.free += [self.register[i] for i in dict.fromkeys(values) if self.last[i] == k and i in self.register]

    def take(self, i: int) -> int:
        if not self.free:
            self.free.append(self.count)
            self.count += 1
        self.register[i] = self.free.pop()
        return self.register[i]


def _in_runs(rows: Sequence[tuple[Expression, tuple[int, ...]]]) -> np.ndarray:
    code: list[int] = []
    begin = 0
    for k, (instruction, locations) in enumerate(rows):
        if k == 0 or rows[k - 1][0] != instruction:
            begin = len(code) + 1
            code += [NUMBERS[instruction], 0]
        code[begin] += 1
        code += locations
    return np.array(code, np.int32)


# --- Batch elements in lanes ------------------------------------------------------------------------------------------


def _lane_bytecode(
    listing: OperationList, outputs: Sequence[Sequence[int]], types: Sequence[Any], arguments: tuple[int, ...]
) -> tuple[Bytecode, dict[int, int]]:
    """Bytecode that keeps its results in registers, and the registers of all values."""
    operations, kept = listing.operations, {i for output in outputs for i in output}
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
        locations = tuple(registers.register[o] for o in operands)
        registers.release(k, operands)
        rows.append((instruction, (registers.take(i), *locations, *extra)))
    numbers = np.array([_lane(operations[i], listing.dtype) for i in constants], listing.dtype)
    return Bytecode(_in_runs(rows), numbers, registers.count, arguments), registers.register


def _type_name(dtype: Any) -> str:
    return "float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name


def _lane(operation: Operation, dtype: np.dtype) -> Any:
    """A constant as a number with the bits of its lane."""
    if operation.kind == "f":
        return dtype.type(float(operation.constant))
    bits = 8 * dtype.itemsize
    integer = -int(operation.constant == "True") if operation.kind == "b" else int(operation.constant)
    return np.array(integer % 2**bits, f"uint{bits}").view(dtype)


# --- Elements in blocks -----------------------------------------------------------------------------------------------


class _Blocks:
    """Assembles a pointwise program. A location is a kind of memory (register, shared, input, output) and an index."""

    def __init__(
        self, listing: OperationList, types: Sequence[Any], rows: Sequence[int], own: list[list[int]], sums: list[int]
    ) -> None:
        self.listing, self.types, self.rows, self.own, self.sums = listing, types, rows, own, sums
        self.operations = listing.operations
        self.needed = _needed(self.operations, [*own, sums])
        self.inputs = [i for i in self.needed if self.operations[i].name == "input" and not self.operations[i].shared]
        self.locations: dict[int, tuple[str, int]] = {}
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
        read = tuple(sorted({operations[i].constant[0] for i in self.needed if operations[i].name == "input"}))
        program, registers = _lane_bytecode(self.listing, [shared], self.types, read)
        self.locations |= {i: ("shared", k) for k, i in enumerate(shared)}
        self.locations |= {i: ("input", k) for k, i in enumerate(self.inputs) if operations[i].kind == "f"}
        num_registers = self.locate_steps(steps)
        begin = {"register": 0, "shared": num_registers, "input": num_registers + len(shared)}
        begin |= {"output": begin["input"] + len(self.inputs), "number": 0}
        rows = [(name, tuple(begin[kind] + k for kind, k in locations)) for name, locations in self.code]
        outputs = [
            (k, c, len(output), self.bytes(i)) for k, output in enumerate(self.own) for c, i in enumerate(output)
        ]
        return BlockBytecode(
            program, _in_runs(rows), num_registers, len(self.sums), tuple(registers[i] for i in shared),
            tuple(self.row(i, read) for i in self.inputs), tuple(outputs), read,
        )  # fmt: skip

    def summed_products(self) -> list[_Step]:
        """Products whose only consumer is one sum."""
        operations = self.operations
        users = Counter(o for i in self.needed for o in operations[i].operands)
        users.update([i for output in (*self.own, self.sums) for i in output])
        products = [i for i in self.sums if users[i] == 1 and operations[i].name == "mul"]
        varying = [i for i in products if not any(operations[o].shared for o in operations[i].operands)]
        return [_Step("sum_of_products", i, operations[i].operands) for i in varying]

    def locate_steps(self, steps: Sequence[_Step]) -> int:
        """Assigns locations, appends the code, and returns the number of registers."""
        operations, registers = self.operations, _Registers(steps, set())
        wanted: dict[int, list[int]] = defaultdict(list)
        for k, i in enumerate(i for output in self.own for i in output):
            wanted[i].append(k)
        sums: dict[int, list[int]] = defaultdict(list)
        for k, i in enumerate(self.sums):
            sums[i].append(k)
        for k, (instruction, i, operands, _) in enumerate(steps):
            locations = tuple(self.locations[o] for o in operands)
            registers.release(k, operands)
            if instruction == "sum_of_products":
                self.code.append((instruction, (("number", sums.pop(i)[0]), *locations)))
                continue
            if wanted[i] and operations[i].kind == "f":
                self.locations[i] = ("output", wanted[i].pop(0))
            else:
                self.locations[i] = ("register", registers.take(i))
            if operations[i].name == "input":
                locations = (("input", self.inputs.index(i)),)
            self.code.append((instruction, (self.locations[i], *locations)))
            self.deliver(i, wanted.pop(i), sums.pop(i, []))
            registers.release(k, [i])
        temporary = registers.count
        for i in {**wanted, **sums}:  # inputs and shared values
            kind = "f" if operations[i].kind == "f" else "w"
            if operations[i].shared:
                self.code.append((("copy", kind.upper()), (("register", temporary), self.locations[i])))
                self.locations[i] = ("register", temporary)
            self.deliver(i, wanted.get(i, []), sums.get(i, []))
        return temporary + 1

    def deliver(self, i: int, outputs: list[int], sums: list[int]) -> None:
        """Appends copies of a computed value to outputs and sums."""
        instruction = ("copy", "f") if self.operations[i].kind == "f" else "store_bool"
        self.code += [(instruction, (("output", k), self.locations[i])) for k in outputs]
        self.code += [("sum", (("number", k), self.locations[i])) for k in sums]

    def row(self, i: int, read: tuple[int, ...]) -> tuple[int, int, int, int]:
        """Where an input lies, see ``BlockBytecode.inputs``."""
        argument, offset = self.operations[i].constant
        return read.index(argument), offset, self.rows[argument], self.bytes(i)

    def conversion(self, i: int) -> str:
        return f"convert_{_type_name(self.types[self.operations[i].constant[0]])}"

    def bytes(self, i: int) -> int:
        operation = self.operations[i]
        if operation.name == "input" and not operation.shared and i in self.inputs:
            return np.dtype(self.types[operation.constant[0]]).itemsize
        return 1 if operation.kind == "b" else self.listing.dtype.itemsize


__all__ = ["BlockBytecode", "Bytecode", "assemble", "assemble_blocks"]
