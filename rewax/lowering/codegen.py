"""Programs of arithmetic on numbers as C++: one loop over elements that keeps every intermediate value in registers.

XLA's CPU compiler makes a loop, and a store, of every array that has two users. Arithmetic on the components of 3x3
matrices is all such arrays: a hundred loops for a material law, four hundred for its derivative, most of the time to
compile and much of the time to run. ``kernel_source`` writes the traced program of *one* element as C++ instead, with
a vector of elements in place of each number.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jax.extend.core import ClosedJaxpr

from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.operations import Operation, UnsupportedError

KERNEL = "rewax_kernel"
"""Name of the function that ``kernel_source`` writes."""

HEADER = Path(__file__).with_name("lanes.h")


def kernel_source(program: ClosedJaxpr, varies: Sequence[bool], summed: Sequence[bool]) -> str:
    """C++ of a program: a function ``KERNEL`` that computes some elements of one copy.

    Its arguments: the program's operands; its results, first those that are not summed, then one array of (copies,
    chunks, numbers) for the sums over each chunk's elements of all numbers that are; sizes, namely how many elements
    and chunks a copy has, how many elements a chunk, and for each operand how far apart copies are; which copy; which
    chunk; its first element, and the one after its last.

    Args:
      program: of one element. Small arrays are spelled out number by number.
      varies: which of its inputs have numbers of their own for each element; their last axis is 1 here and the number
        of elements there. The others are the same for all elements.
      summed: which of its outputs are to be summed over the elements; the others have a last axis as those inputs.

    Raises:
      UnsupportedError: there is an operation that is not arithmetic, or more than one floating type.
    """
    operations, outputs, dtype = from_jaxpr(program, varies)
    buffers = [_BUFFERS[np.dtype(aval.dtype)] for aval in program.in_avals]
    own = [output for output, total in zip(outputs, summed, strict=True) if not total]
    sums = [value for output, total in zip(outputs, summed, strict=True) if total for value in output]
    kind = "double" if dtype == np.float64 else "float"
    return f"typedef {kind} T;\n{HEADER.read_text()}\n{_Writer(operations).kernel(own, sums, buffers)}"


class _Writer:
    """Statements of operations: ``s3`` is a number for all elements, ``w3`` the same in all lanes, ``v3`` one each."""

    def __init__(self, operations: list[Operation]) -> None:
        self.operations = operations

    def kernel(self, outputs: list[list[int]], sums: list[int], buffers: list[str]) -> str:
        used = self.used([*(i for output in outputs for i in output), *sums])
        wide = {o for i in used if not self.operations[i].shared for o in self.operations[i].operands}
        wide |= {*sums, *(i for output in outputs for i in output)}
        operands = [
            f"const {buffer}* const p{k} = static_cast<const {buffer}*>(operands[{k}]) + copy * sizes[{k + 3}];"
            for k, buffer in enumerate(buffers)
        ]
        shared = [self.statement(i, "U") for i in used if self.operations[i].shared]
        shared += [
            f"const {'V' if self.operations[i].kind == 'f' else 'VI'} w{i} = Wide(s{i});"
            for i in used
            if self.operations[i].shared and i in wide
        ]
        results, stores = [], []
        for k, output in enumerate(outputs):
            kind = self.operations[output[0]].kind
            if kind in ("i", "l"):
                raise UnsupportedError("it returns whole numbers")
            buffer, store = ("T", "Store") if kind == "f" else ("bool", "StoreTruth")
            results.append(
                f"{buffer}* const r{k} = static_cast<{buffer}*>(results[{k}]) + copy * {len(output)} * count;"
            )
            stores += [f"{store}(r{k} + {c} * count + i, {self.name(i, 'V')}, left);" for c, i in enumerate(output)]
        stores += [f"t{k} += Part({self.name(i, 'V')}, left);" for k, i in enumerate(sums)]
        totals = [f"V t{k} = V{{}};" for k in range(len(sums))]
        if sums:
            results.append(
                f"T* const t = static_cast<T*>(results[{len(outputs)}]) + (copy * chunks + chunk) * {len(sums)};"
            )
        each = [self.statement(i, "V") for i in used if not self.operations[i].shared]
        lines = "\n".join
        return f"""
extern "C" void {KERNEL}(const void* const* operands, void* const* results, const int64_t* sizes, int64_t copy,
                             int64_t chunk, int64_t begin, int64_t end) {{
const int64_t count = sizes[0], chunks = sizes[1];
{lines(operands)}
{lines(results)}
{lines(shared)}
{lines(totals)}
for (int64_t i = begin; i < end; i += kLanes) {{
const int left = static_cast<int>(end - i < kLanes ? end - i : kLanes);
{lines(each)}
{lines(stores)}
}}
{lines(f"t[{k}] = Total(t{k});" for k in range(len(sums)))}
}}
"""

    def used(self, outputs: list[int]) -> list[int]:
        """Operations that the outputs need, in order."""
        needed, rest = set(), list(outputs)
        while rest:
            i = rest.pop()
            if i not in needed:
                needed.add(i)
                rest += self.operations[i].operands
        return sorted(needed)

    def name(self, i: int, vector: str) -> str:
        if not self.operations[i].shared:
            return f"v{i}"
        return f"w{i}" if vector == "V" else f"s{i}"

    def statement(self, i: int, vector: str) -> str:
        """The statement of one operation, of one number (U) or of several elements (V)."""
        operation = self.operations[i]
        kind = vector if operation.kind == "f" else vector + "I"
        if operation.name == "constant":
            value = _literal(operation.constant, operation.kind)
            text = f"{kind}{{{value}}}"
        elif operation.name == "input":
            place, offset = operation.constant
            if vector == "U":
                number = f"p{place}[{offset}]"
                text = f"{kind}{{{'-' if operation.kind == 'b' else ''}{number}}}"
            else:
                load = {"f": "Load", "i": "LoadWhole", "l": "LoadWhole", "b": "LoadTruth"}[operation.kind]
                text = f"{load}(p{place} + {offset} * count + i, left)"
        else:
            names = [self.name(o, vector) for o in operation.operands]
            text = TEXT[operation.name].format(*names, kind=kind)
        return f"const {kind} {self.name(i, vector if not operation.shared else 'U')} = {text};"


def _literal(text: str, kind: str) -> str:
    if kind == "b":
        return "-1" if text == "True" else "0"
    if kind in ("i", "l"):
        return f"({int(text) + 1}LL - 1)"  # the least integer has no literal
    return {"inf": "kInfinity", "-inf": "-kInfinity", "nan": "kNaN"}.get(text, f"T({text})")


_BUFFERS = {
    np.dtype(np.float32): "T",
    np.dtype(np.float64): "T",
    np.dtype(np.int32): "int32_t",
    np.dtype(np.int64): "int64_t",
    np.dtype(np.bool_): "bool",
}
TEXT = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "Div({0}, {1})",
    "rem": "Rem({0}, {1})",
    "neg": "-{0}",
    "max": "Max({0}, {1})",
    "min": "Min({0}, {1})",
    "abs": "Abs({0})",
    "sign": "Sign({0})",
    "sqrt": "Sqrt({0})",
    "rsqrt": "T(1) / Sqrt({0})",
    "cbrt": "Cbrt({0})",
    "exp": "Exp({0})",
    "exp2": "Exp2({0})",
    "log": "Log({0})",
    "log1p": "Log1p({0})",
    "expm1": "Expm1({0})",
    "sin": "Sin({0})",
    "cos": "Cos({0})",
    "asin": "Asin({0})",
    "acos": "Acos({0})",
    "atan": "Atan({0})",
    "sinh": "Sinh({0})",
    "cosh": "Cosh({0})",
    "tanh": "Tanh({0})",
    "asinh": "Asinh({0})",
    "acosh": "Acosh({0})",
    "atanh": "Atanh({0})",
    "erf": "Erf({0})",
    "erfc": "Erfc({0})",
    "logistic": "T(1) / (T(1) + Exp(-{0}))",
    "pow": "Pow({0}, {1})",
    "atan2": "Atan2({0}, {1})",
    "floor": "Floor({0})",
    "ceil": "Ceil({0})",
    "round_even": "RoundEven({0})",
    "round_away": "RoundAway({0})",
    "is_finite": "IsFinite({0})",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "gt": "{0} > {1}",
    "ge": "{0} >= {1}",
    "eq": "{0} == {1}",
    "ne": "{0} != {1}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "xor": "{0} ^ {1}",
    "not": "~{0}",
    "select": "{0} ? {1} : {2}",
    "b_to_f": "__builtin_convertvector(-{0}, {kind})",
    "i_to_f": "__builtin_convertvector({0}, {kind})",
    "l_to_f": "__builtin_convertvector({0}, {kind})",
    "f_to_i": "ToWhole({0}, 32)",
    "f_to_l": "ToWhole({0}, 64)",
    "b_to_i": "-{0}",
    "b_to_l": "-{0}",
    "i_to_b": "{0} != 0",
    "l_to_b": "{0} != 0",
    "f_to_b": "{0} != 0",
    "i_to_l": "{0}",
    "l_to_i": "Wrap({0})",
    "wrap": "Wrap({0})",
}
