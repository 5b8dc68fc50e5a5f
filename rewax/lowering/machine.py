"""Long programs of arithmetic for many environments side by side, as tapes that one small machine in C++ runs.

A substep of articulated bodies is tens of thousands of operations on single numbers, in hundreds of small arrays. XLA's
CPU compiler makes hundreds of loops of them, most of the time to compile and much of the time to run; a C++ compiler
takes a minute. A *tape* (Wengert list) needs no compiler: it is the list of operations itself, equal ones in runs, and
the machine that runs it (``tape.cc``, built once for all tapes) applies each to a vector of environments.
"""

import ctypes
import functools
import hashlib
import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering import build
from rewax.lowering.codegen import HEADER, TEXT
from rewax.lowering.ffi_layout import batch_shape, cpu_rules, operands_of, trace_rule
from rewax.lowering.from_jaxpr import OperationList, from_jaxpr
from rewax.lowering.linear_primitive import Arrays
from rewax.lowering.operations import OF_TRUTH, OF_WHOLE, Operation, UnsupportedError
from rewax.lowering.recompute import RECOMPUTED, Program, run_program, split_arguments

T = TypeVar("T")

_MOST_OPERATIONS = 500_000
"""Of a tape; more would take as long to write as XLA takes to compile."""

_FUSED = {("add", 0): "a_times_b_plus_c", ("sub", 0): "a_times_b_minus_c", ("sub", 1): "c_minus_a_times_b"}
"""A sum and the product that is one of its terms, by the term's place, as one instruction."""


def interpreted(function: Callable[..., T], derivative_of: Callable[..., T] | None = None) -> Callable[..., T]:
    """``recomputed``, whose value and derivatives are tapes on a CPU with a C++ compiler.

    Under ``vmap`` the copies of the program run in the lanes of vectors. What is no arithmetic at known places, a
    ``while_loop`` for instance, is left to XLA, pass by pass: so are all passes without a compiler, and on a GPU.

    Args:
      function, derivative_of: as for ``recomputed``, of small arrays of one floating type and fixed shapes.

    Gradient: as for ``recomputed``.
    """

    @functools.wraps(function)
    def call(*args: Any) -> T:
        arrays, treedef, constants = split_arguments(args)
        passes = INTERPRETED if build.is_available() else RECOMPUTED
        return run_program(Program(passes, function, derivative_of, treedef, constants), arrays)

    return call


class Tape(NamedTuple):
    """A program as the machine reads it."""

    code: np.ndarray
    """Runs: an instruction, how often, and the places of each time; int32."""
    constants: np.ndarray
    num_slots: int
    """So many vectors it works with."""
    operands: tuple[int, ...]
    """Which arguments it reads."""


class _Target(NamedTuple):
    """A tape that XLA can call."""

    handler: str
    number: int
    operands: tuple[int, ...]
    outputs: tuple[tuple[tuple[int, ...], Any], ...]
    """Shape and type of each result of one copy."""


def _run(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """One pass: by a tape if there is one."""
    operands = operands_of(program, arrays, linear, [False] * (len(arrays) + len(linear)))
    avals = tuple(o.of_one_element for o in operands)
    target = _target(which, program._replace(batches=()), avals, len(arrays), jnp.result_type(float))
    if target is None:
        return _with_jax(which, program, arrays, linear)
    batch = batch_shape(operands)
    used = [operands[k] for k in target.operands]
    full = [(shape, dtype) for shape, dtype in target.outputs if math.prod(shape)]
    sizes = [math.prod(batch), len(used), *(o.step for o in used), *(math.prod(shape) for shape, _ in full)]
    results = [jax.ShapeDtypeStruct((*batch, *shape), dtype) for shape, dtype in full]
    call = jax.ffi.ffi_call(target.handler, results)
    found = iter(call(*(o.laid_out(batch) for o in used), number=np.int64(target.number), sizes=np.array(sizes)))
    return tuple(
        next(found) if math.prod(shape) else jnp.zeros((*batch, *shape), dtype) for shape, dtype in target.outputs
    )


INTERPRETED = cpu_rules(_run)


def _with_jax(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """The same without a tape."""
    return getattr(RECOMPUTED, which)(program, arrays, linear)


@functools.lru_cache(maxsize=1024)
def _target(which: str, program: Program, avals: tuple, count: int, precision: Any) -> _Target | None:
    """The tape of one pass, known to XLA; None if there is none."""
    del precision  # which types Python's numbers become
    traced = trace_rule(which, program, avals, count)
    try:
        line = from_jaxpr(traced, [True] * len(avals), most=_MOST_OPERATIONS)
        tape = written(line, [aval.dtype for aval in traced.in_avals])
    except UnsupportedError:
        return None
    source, handler = machine(line.dtype)
    registered = build.register(source, (handler,))
    library, reason = build.load(source)
    if library is None or not registered:
        warnings.warn(f"rigid bodies are computed with JAX, slower than in C++: {reason}", stacklevel=2)
        return None
    digest = hashlib.sha256(tape.code.tobytes() + tape.constants.tobytes() + handler.encode())
    number = int.from_bytes(digest.digest()[:7])  # the same in every process, for compiled programs are kept
    library.rewax_add_tape(
        ctypes.c_int64(number),
        tape.code.ctypes.data_as(ctypes.c_void_p),
        ctypes.c_int64(len(tape.code)),
        tape.constants.ctypes.data_as(ctypes.c_void_p),
        ctypes.c_int64(len(tape.constants)),
        ctypes.c_int64(tape.num_slots),
    )
    return _Target(handler, number, tape.operands, tuple((a.shape, a.dtype) for a in traced.out_avals))


# --- The tape ---------------------------------------------------------------------------------------------------------


def written(line: OperationList, types: Sequence[Any]) -> Tape:
    """The tape of a program.

    Args:
      line: its operations.
      types: of its arguments.

    Raises:
      UnsupportedError: it returns whole numbers or truth values.
    """
    operations, outputs = line.operations, line.outputs
    if any(operations[i].kind != "f" for output in outputs for i in output):
        raise UnsupportedError("it returns whole numbers or truth values")
    steps = list(_steps(operations, [i for output in outputs for i in output]))
    constants = {i: k for k, i in enumerate(i for i, name, _ in steps if name == "constant")}
    operands = sorted({operations[i].constant[0] for i, name, _ in steps if name == "input"})
    slots = _Slots(steps, outputs)
    rows: list[tuple[str, tuple[int, ...]]] = []
    for i, name, used in steps:
        operation, places = operations[i], slots.of(i, used)
        if name == "constant":
            rows.append(("constant", (places[0], constants[i])))
        elif name == "input":
            argument, offset = operation.constant
            rows.append((f"load_{np.dtype(types[argument]).name}", (places[0], operands.index(argument), offset)))
        else:
            rows.append((name, places))
    full = [output for output in outputs if output]
    for k, output in enumerate(full):
        rows += [("store", (slots.place[i], k, offset)) for offset, i in enumerate(output)]
    numbers = np.array([_lane(operations[i], line.dtype) for i in constants], line.dtype)
    return Tape(_in_runs(rows), numbers, slots.count, tuple(operands))


def _steps(operations: Sequence[Operation], outputs: Sequence[int]) -> Iterator[tuple[int, str, tuple[int, ...]]]:
    """Operations that outputs need, in order, each with its instruction's name and the operations it reads."""
    needed, rest = set(), list(outputs)
    while rest:
        i = rest.pop()
        if i not in needed:
            needed.add(i)
            rest += operations[i].operands
    order = sorted(needed)
    users = Counter([o for i in order for o in operations[i].operands] + list(outputs))
    fused = {}
    for i in order:
        if operations[i].name in ("add", "sub") and operations[i].kind == "f":
            for place, o in enumerate(operations[i].operands):
                if operations[o].name == "mul" and users[o] == 1:
                    fused[i] = (place, o)
    inner = {o for _, o in fused.values()}
    for i in order:
        if i in inner:
            continue
        operation = operations[i]
        if i in fused:
            place, product = fused[i]
            name = _FUSED[operation.name, 0 if operation.name == "add" else place]
            yield i, name, (*operations[product].operands, operation.operands[1 - place])
        elif operation.name in ("constant", "input"):
            yield i, operation.name, ()
        else:
            whole = "".join("f" if operations[o].kind == "f" else "w" for o in operation.operands)
            yield i, f"{operation.name}_{whole}", operation.operands


class _Slots:
    """Where the machine keeps the values of operations; the place of one that nobody needs any more is used again."""

    def __init__(self, steps: Sequence[tuple[int, str, tuple[int, ...]]], outputs: Sequence[Sequence[int]]) -> None:
        self.place: dict[int, int] = {}
        self.count = 0
        self.free: list[int] = []
        self.last = {o: i for i, _, used in steps for o in used}
        self.last |= {i: -1 for output in outputs for i in output}

    def of(self, i: int, used: tuple[int, ...]) -> tuple[int, ...]:
        """Of an operation and of those it reads. It may take the place of one of them."""
        places = tuple(self.place[o] for o in used)
        self.free += [self.place[o] for o in dict.fromkeys(used) if self.last[o] == i]
        if not self.free:
            self.free.append(self.count)
            self.count += 1
        self.place[i] = self.free.pop()
        return (self.place[i], *places)


def _in_runs(rows: Sequence[tuple[str, tuple[int, ...]]]) -> np.ndarray:
    code: list[int] = []
    begin = 0
    for k, (name, places) in enumerate(rows):
        if k == 0 or rows[k - 1][0] != name:
            begin = len(code) + 1
            code += [_NUMBERS[name], 0]
        code[begin] += 1
        code += places
    return np.array(code, np.int32)


def _lane(operation: Operation, dtype: np.dtype) -> Any:
    """A constant as the number whose bits the machine finds in a lane."""
    if operation.kind == "f":
        return dtype.type(float(operation.constant))
    whole = {"i": int, "b": lambda text: -1 if text == "True" else 0}[operation.kind](operation.constant)
    return np.array(whole, f"int{8 * dtype.itemsize}").view(dtype)


# --- The machine ------------------------------------------------------------------------------------------------------


def _instructions() -> dict[str, tuple[int, str]]:
    """For each instruction how many places it has, and the statement that it is."""
    found = {}

    def add(name: str, text: str, kinds: str) -> None:
        names = [f"{'' if kind == 'f' else '(VI)'}s[at[{k}]]" for k, kind in enumerate(kinds, start=1)]
        found[f"{name}_{kinds}"] = (1 + len(kinds), f"s[at[0]] = (V)({text.format(*names, kind='V')});")

    for name, text in TEXT.items():
        arity = 3 if "{2}" in text else 2 if "{1}" in text else 1
        if name == "select":
            add(name, text, "wff")
            add(name, text, "www")
        elif "_to_" in name:
            add(name, text, "f" if name.startswith("f") else "w")
        else:
            if name not in ("and", "or", "xor", "not"):
                add(name, text, "f" * arity)
            if name in OF_TRUTH | OF_WHOLE:
                add(name, text, "w" * arity)
    for name, text in zip(_FUSED.values(), ("{0} * {1} + {2}", "{0} * {1} - {2}", "{2} - {0} * {1}"), strict=True):
        add(name, text, "fff")
        found[name] = found.pop(f"{name}_fff")
    found["constant"] = (2, "s[at[0]] = Full<V>(tape.constants[static_cast<size_t>(at[1])]);")
    from_operand = "(static_cast<const {0}*>(operands[at[1]]) + first * steps[at[1]] + at[2], steps[at[1]], count)"
    for name, buffer in (
        ("float32", "T"),
        ("float64", "T"),
        ("int32", "int32_t"),
        ("int64", "int64_t"),
        ("bool", "bool"),
    ):
        value = ("Gather" if buffer == "T" else "(V)GatherWhole") + from_operand.format(buffer)
        found[f"load_{name}"] = (
            3,
            f"s[at[0]] = {value};" if buffer != "bool" else f"s[at[0]] = (V)(-{value.replace('(V)', '')});",
        )
    found["store"] = (
        3,
        "{ const int64_t step = steps[num_operands + static_cast<size_t>(at[1])]; "
        "T* to = static_cast<T*>(results[at[1]]) + first * step + at[2]; "
        "for (int l = 0; l < count; ++l) to[l * step] = s[at[0]][l]; }",
    )
    return found


_INSTRUCTIONS = _instructions()
_NUMBERS = {name: number for number, name in enumerate(_INSTRUCTIONS)}


class Machine(NamedTuple):
    """The program that runs tapes of a floating type."""

    source: build.Source
    handler: str
    """What XLA calls."""


@functools.cache
def machine(dtype: np.dtype) -> Machine:
    """The machine of a floating type, float32 or float64."""
    kind = {"float32": "float", "float64": "double"}[dtype.name]
    cases = " \\\n".join(
        f"case {_NUMBERS[name]}: for (; times; --times, at += {places}) {statement} break;"
        for name, (places, statement) in _INSTRUCTIONS.items()
    )
    handler = f"rewax_tape_{kind}"
    parts = (
        build.THREADS.read_text(),
        f"typedef {kind} T;",
        HEADER.read_text(),
        f"#define REWAX_TAPE {handler}\n#define REWAX_CASES \\\n{cases}\n",
        Path(__file__).with_suffix(".cc").read_text(),
    )
    return Machine(build.Source("tape", "\n".join(parts), ("-O2", "-ftree-vectorize")), handler)


__all__ = ["Machine", "Tape", "interpreted", "machine", "written"]
