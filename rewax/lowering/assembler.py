"""Assembles pointwise programs: lists of operations become bytecode for many elements per batch element."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rewax.lowering.from_jaxpr import OperationList
from rewax.lowering.instructions import Expression
from rewax.lowering.lane_assembler import Bytecode, in_registers, type_name
from rewax.lowering.operations import UnsupportedError
from rewax.lowering.selection import Cover, Registers, Step, in_runs, needed_for


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


class _Blocks:
    """Assembles a pointwise program. A location is a kind of memory (register, shared, input, output) and an index."""

    def __init__(
        self, listing: OperationList, types: Sequence[Any], rows: Sequence[int], own: list[list[int]], sums: list[int]
    ) -> None:
        self.listing, self.types, self.rows, self.own, self.sums = listing, types, rows, own, sums
        self.operations = listing.operations
        self.needed = needed_for(listing, [*own, sums])
        self.inputs = [i for i in self.needed if self.operations[i].name == "input" and not self.operations[i].shared]
        self.locations: dict[int, tuple[str, int]] = {}
        self.code: list[tuple[Expression, tuple[Any, ...]]] = []

    def assembled(self) -> BlockBytecode:
        operations, products = self.operations, self.summed_products()
        kept = {i for output in self.own for i in output} | set(self.sums) | {o for p in products for o in p.operands}
        varying = [i for i in self.needed if not operations[i].shared and all(i != p.operation for p in products)]
        steps = [Step(self.conversion(i), i, ()) for i in self.inputs if operations[i].kind != "f"]
        steps += [*products, *Cover(operations, varying, kept, lanes=False).steps()]
        steps.sort(key=lambda step: step.operation)
        shared = sorted(
            {o for s in steps for o in s.operands if operations[o].shared} | {i for i in kept if operations[i].shared}
        )
        read = tuple(sorted({operations[i].constant[0] for i in self.needed if operations[i].name == "input"}))
        program, registers = in_registers(self.listing, [shared], self.types, read)
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
            program, in_runs(rows), num_registers, len(self.sums), tuple(registers[i] for i in shared),
            tuple(self.row(i, read) for i in self.inputs), tuple(outputs), read,
        )  # fmt: skip

    def summed_products(self) -> list[Step]:
        """Products whose only consumer is one sum."""
        operations = self.operations
        users = Counter(o for i in self.needed for o in operations[i].operands)
        users.update([i for output in (*self.own, self.sums) for i in output])
        products = [i for i in self.sums if users[i] == 1 and operations[i].name == "mul"]
        varying = [i for i in products if not any(operations[o].shared for o in operations[i].operands)]
        return [Step("sum_of_products", i, operations[i].operands) for i in varying]

    def locate_steps(self, steps: Sequence[Step]) -> int:
        """Assigns locations, appends the code, and returns the number of registers."""
        operations, registers = self.operations, Registers(steps, set())
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
        return f"convert_{type_name(self.types[self.operations[i].constant[0]])}"

    def bytes(self, i: int) -> int:
        operation = self.operations[i]
        if operation.name == "input" and not operation.shared and i in self.inputs:
            return np.dtype(self.types[operation.constant[0]]).itemsize
        return 1 if operation.kind == "b" else self.listing.dtype.itemsize


__all__ = ["BlockBytecode", "assemble_blocks"]
