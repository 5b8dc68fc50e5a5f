"""Instructions of the machine: single operations, and small expressions that are frequent in programs of tasks.

An instruction reads blocks of elements from memory, computes an expression in processor registers, and writes one
block. Loads and the store dominate its cost: an expression of five operations costs little more than one operation.
``benchmarks/lowering.py --mine`` counts the expressions of ``FUSED`` in the programs of tasks.
"""

import ast
import itertools
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

from rewax.lowering.operations import ON_BOOLEANS, ON_INTEGERS

Expression = str | tuple
"""An operand, ``f`` (floating-point) or ``w`` (integer or boolean), in capitals if all elements share it; or a tuple of
an operation's name and its operands."""

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
    "tan": "Tan({0})",
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
    "f_to_i": "ToInteger({0}, 32)",
    "f_to_l": "ToInteger({0}, 64)",
    "b_to_i": "-{0}",
    "b_to_l": "-{0}",
    "i_to_b": "{0} != 0",
    "l_to_b": "{0} != 0",
    "f_to_b": "{0} != 0",
    "i_to_l": "{0}",
    "l_to_i": "Wrap({0})",
    "wrap": "Wrap({0})",
    "copy": "{0}",
}
"""C++ of each operation, with the functions of ``lanes.h``; booleans are 0 and -1."""

_ONLY_ON_INTEGERS = frozenset(["and", "or", "xor", "not", "wrap"])
COMMUTATIVE = frozenset(["add", "mul", "and", "or", "xor", "eq", "ne"])

FUSED = """
a * b + c
a * B + c
A * b + C
a - b * c
a * b - c
a * b + c * d
a * B + c * D
a * b - c * d
a * b + c * d + e * f
a * b + (c * d + e)
a * B + c * D + e * F
a + b * c * d
a * b * c + (d * e + f)
a + B * (c * d)
A + (a * B + b)
B * (a + c * d)
a * b * c
A * b * c
-(a * b)
a + -b
sqrt(a * a1 + b * b1)
rsqrt(A + a * b)
A + (max(a, abs(b)) + abs(c))
a * select(b >= A, B, C) / c
a * (b / select(c == A, c1, B))
a * (b / select(c == A, B, C))
select(a == b, A, B)
select(a < B, A, C)
select(w, a * b, c)
select(w, A, a * b)
select(w, a / b, A)
select(w, select(x, A, B), a * b)
select(w, A, B) / select(x, C, D)
select(w, a, A) + b
abs(a) - B
(a > A) & (b < B)
B * (a + b + c)
B * (a - b + c - d)
"""
"""Fused expressions in Python syntax: all elements share operands in capitals; w and x are booleans."""


class Instruction(NamedTuple):
    """An instruction of the machine."""

    expression: Expression
    operands: tuple[str, ...]
    """Kinds of its operands, in reading order."""


def operands_in(expression: Expression) -> Iterator[str]:
    """Operands of an expression, from left to right."""
    if isinstance(expression, str):
        yield expression
    else:
        for part in expression[1:]:
            yield from operands_in(part)


def _parse(node: ast.AST) -> Expression:
    match node:
        case ast.Name(id=name):
            kind = "w" if name[0] in "wx" else "f"
            return kind.upper() if name.isupper() else kind
        case ast.BinOp(left=left, op=op, right=right):
            names = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.Div: "div", ast.BitAnd: "and"}
            return (names[type(op)], _parse(left), _parse(right))
        case ast.UnaryOp(operand=operand):
            return ("neg", _parse(operand))
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            names = {ast.Lt: "lt", ast.LtE: "le", ast.Gt: "gt", ast.GtE: "ge", ast.Eq: "eq"}
            return (names[type(op)], _parse(left), _parse(right))
        case ast.Call(func=ast.Name(id=name), args=args):
            return (name, *map(_parse, args))
    raise ValueError(f"not an expression of an instruction: {ast.unparse(node)}")


def _simple() -> Iterator[Expression]:
    """Single operations, for each combination of operand kinds in which at least one operand varies."""
    for name, text in TEXT.items():
        arity = 3 if "{2}" in text else 2 if "{1}" in text else 1
        if name == "select":
            kinds = [k for pair in ("fF", "wW") for k in itertools.product("wW", pair, pair) if set(k) & {"f", "w"}]
        elif name == "copy":
            kinds = [("f",), ("F",), ("w",), ("W",)]
        elif "_to_" in name:
            kinds = [("f" if name.startswith("f") else "w",)]
        else:
            pairs = ["fF"] * (name not in _ONLY_ON_INTEGERS) + ["wW"] * (name in ON_BOOLEANS | ON_INTEGERS)
            kinds = [k for pair in pairs for k in itertools.product(pair, repeat=arity) if pair[0] in k]
        yield from ((name, *k) for k in kinds)


def _instructions() -> list[Instruction]:
    fused = [_parse(ast.parse(line, mode="eval").body) for line in FUSED.strip().splitlines()]
    return [Instruction(e, tuple(operands_in(e))) for e in dict.fromkeys([*_simple(), *fused])]


INSTRUCTIONS = _instructions()
NUMBERS = {instruction.expression: number for number, instruction in enumerate(INSTRUCTIONS)}
BY_NAME: dict[str, list[int]] = defaultdict(list)
"""Indices of the instructions whose last operation has a name."""
for _number, _instruction in enumerate(INSTRUCTIONS):
    BY_NAME[_instruction.expression[0]].append(_number)
SPECIAL = ("constant", "load_float", "load_int32", "load_int64", "load_bool", "store", "convert_int32", "convert_int64",
           "convert_bool", "store_bool", "sum", "sum_of_products", "loop_exit", "loop_back")  # fmt: skip
"""Instructions that move numbers between registers and arrays, and those of loops; ``machine.cc`` holds their C++."""
NUMBERS |= {name: len(INSTRUCTIONS) + k for k, name in enumerate(SPECIAL)}


def cases() -> str:
    """C++ of each instruction, as cases of the switch in ``machine.cc``."""
    found = []
    for number, (expression, kinds) in enumerate(INSTRUCTIONS):
        before, each = [], []
        for k, kind in enumerate(kinds):
            vector = "V" if kind in "fF" else "VI"
            if kind.isupper():
                before.append(f"const {vector} a{k} = Shared<{vector}>(OPERAND({k + 1}));")
            else:
                before.append(f"const T* const p{k} = OPERAND({k + 1});")
                each.append(f"const {vector} a{k} = Get<{vector}>(p{k} + k);")
        value = _statement(expression, iter(f"a{k}" for k in range(len(kinds))))
        found.append(
            f"case {number}: REPEAT({len(kinds) + 1}) {{ T* const to = OPERAND(0); {' '.join(before)} "
            f"EACH {{ {' '.join(each)} Put(to + k, {value}); }} }} break;"
        )
    return "\n".join(found)


def _statement(expression: Expression, names: Iterator[str]) -> str:
    if isinstance(expression, str):
        return next(names)
    name, *operands = expression
    return f"({TEXT[name].format(*(_statement(o, names) for o in operands), kind='V')})"
