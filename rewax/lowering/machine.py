"""The machine: one C++ program that interprets bytecode; ``interpreted`` runs functions in it.

A substep of articulated bodies is tens of thousands of scalar operations in hundreds of small arrays. XLA's CPU
compiler emits hundreds of loops, which take most of the compile time and much of the run time. A C++ compiler would
take a minute per program. Bytecode needs no compiler: the machine is built once for all programs and applies each
instruction to a vector of batch elements.
"""

import ctypes
import functools
import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from rewax.lowering import build, report
from rewax.lowering.assembler import BlockBytecode
from rewax.lowering.bytecode_cache import key_of, remembered
from rewax.lowering.ffi_layout import batch_shape, cpu_rules, operands_of, trace_function, trace_rule
from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.instructions import NUMBERS, SPECIAL, cases
from rewax.lowering.lane_assembler import Bytecode, assemble
from rewax.lowering.linear_primitive import Arrays
from rewax.lowering.operations import UnsupportedError
from rewax.lowering.recompute import RECOMPUTED, Program, run_program, split_arguments, trace_context

T = TypeVar("T")

_MOST_OPERATIONS = 500_000
"""Largest number of operations of a program. Assembling more takes as long as XLA takes to compile."""

_HEADER = Path(__file__).with_name("lanes.h")


def interpreted(function: Callable[..., T], derivative_of: Callable[..., T] | None = None) -> Callable[..., T]:
    """``recomputed``, with its value, JVP and VJP interpreted by the machine on a CPU.

    Under ``vmap`` the batch elements run in the lanes of vectors. XLA runs a rule that is more than arithmetic at
    constant indices and loops (sorting, for instance). Without the machine, and on a GPU, XLA runs all rules.

    Args:
      function, derivative_of: as for ``recomputed``, on small arrays of one floating type.

    Gradient: as for ``recomputed``.
    """

    @functools.wraps(function)
    def call(*args: Any) -> T:
        arrays, treedef, constants = split_arguments(args)
        rules = INTERPRETED if build.is_available() else RECOMPUTED
        return run_program(Program(rules, function, derivative_of, treedef, constants), arrays)

    return call


class _Target(NamedTuple):
    """A program in the machine that XLA can call."""

    handler: str
    number: int
    operands: tuple[int, ...]
    outputs: tuple[tuple[tuple[int, ...], Any], ...]
    """Shape and type of each result of one batch element."""


def _run(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """Runs a rule in the machine if possible, else with JAX."""
    if build.is_off():
        return _with_jax(which, program, arrays, linear)
    operands = operands_of(program, arrays, linear, [False] * (len(arrays) + len(linear)))
    avals = tuple(o.element_aval for o in operands)
    target = _target(which, program._replace(batches=()), avals, len(arrays), trace_context())
    report.note(program.function, which, target if isinstance(target, str) else None)
    if isinstance(target, str):
        return _with_jax(which, program, arrays, linear)
    batch = batch_shape(operands)
    used = [operands[k] for k in target.operands]
    full = [(shape, dtype) for shape, dtype in target.outputs if math.prod(shape)]
    sizes = [math.prod(batch), *(o.step for o in used), *(math.prod(shape) for shape, _ in full)]
    results = [jax.ShapeDtypeStruct((*batch, *shape), dtype) for shape, dtype in full]
    call = jax.ffi.ffi_call(target.handler, results)
    found = iter(call(*(o.laid_out(batch) for o in used), number=np.int64(target.number), sizes=np.array(sizes)))
    return tuple(
        next(found) if math.prod(shape) else jnp.zeros((*batch, *shape), dtype) for shape, dtype in target.outputs
    )


INTERPRETED = cpu_rules(_run)


def _with_jax(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """Runs a rule with JAX."""
    return getattr(RECOMPUTED, which)(program, arrays, linear)


@functools.lru_cache(maxsize=1024)
def _target(which: str, program: Program, avals: tuple, count: int, context: Any) -> _Target | str:
    """The registered bytecode of a rule, or the reason why there is none."""
    del context  # cache key only
    try:
        function = trace_function(which, program, avals[:count])
        key = key_of(function, "lanes", which, program.perturbed, avals)
        dtype, bytecode, outputs = remembered(key, functools.partial(_assembled, which, program, avals, function))
        number, reason = load(dtype, bytecode)
    except UnsupportedError as error:
        return str(error)
    except Exception as error:  # an unforeseen failure: fall back to XLA
        return f"it could not be lowered ({type(error).__name__}: {error})"
    return reason if number is None else _Target(machine(dtype).lanes_handler, number, bytecode.operands, outputs)


def _assembled(which: str, program: Program, avals: tuple, function: ClosedJaxpr) -> tuple[np.dtype, Bytecode, tuple]:
    """The floating type of a rule, its bytecode, and the outputs of ``_Target``."""
    traced = trace_rule(which, program, avals, function)
    listing = from_jaxpr(traced, [True] * len(avals), most=_MOST_OPERATIONS, loops=True)
    bytecode = assemble(listing, [aval.dtype for aval in traced.in_avals])
    return listing.dtype, bytecode, tuple((a.shape, a.dtype) for a in traced.out_avals)


# --- The machine ------------------------------------------------------------------------------------------------------


class Machine(NamedTuple):
    """The C++ program that interprets bytecode of a floating type."""

    source: build.Source
    lanes_handler: str
    """Name of the FFI target for ``Bytecode``."""
    blocks_handler: str
    """Name of the FFI target for ``BlockBytecode``."""
    assembled_handler: str
    """Name of the FFI target for ``BlockBytecode`` on the elements of a mesh, see ``assembled``."""
    split_handler: str
    """Name of the FFI target that splits vectors (``splitting``)."""


@functools.cache
def machine(dtype: np.dtype) -> Machine:
    """The machine of a floating type, float32 or float64."""
    kind = {"float32": "float", "float64": "double"}[dtype.name]
    names = ("lanes", "blocks", "assembled", "split")
    lanes, blocks, assembled, split = (f"rewax_{name}_{kind}" for name in names)
    named = {name: "".join(part.capitalize() for part in name.split("_")) for name in SPECIAL}
    escaped = cases().replace("\n", " \\\n")
    parts = (
        build.THREADS.read_text(),
        f"typedef {kind} T;",
        _HEADER.read_text(),
        f"enum {{ {', '.join(f'k{named[name]} = {NUMBERS[name]}' for name in SPECIAL)} }};",
        f"#define REWAX_LANES_HANDLER {lanes}\n#define REWAX_BLOCKS_HANDLER {blocks}",
        f"#define REWAX_ASSEMBLED_HANDLER {assembled}",
        f"#define REWAX_SPLIT_HANDLER {split}",
        f"#define REWAX_CASES \\\n{escaped}\n",
        Path(__file__).with_name("corners.h").read_text(),
        Path(__file__).with_suffix(".cc").read_text(),
        Path(__file__).with_name("assembled.cc").read_text(),
        Path(__file__).with_name("splitting.cc").read_text(),
    )
    return Machine(build.Source("machine", "\n".join(parts), ("-O2",)), lanes, blocks, assembled, split)


def register(chosen: Machine) -> bool:
    """Registers the handlers of a machine; False if there is no library, see ``build.register``."""
    source, *handlers = chosen
    return build.register(source, tuple(handlers))


def why_in_xla() -> str | None:
    """The reason why all programs for a CPU are left to XLA; None: C++ runs. Builds the machine if need be."""
    library, reason = build.load(machine(np.dtype("float32")).source)
    return None if library is not None else reason


def load(dtype: np.dtype, bytecode: Bytecode | BlockBytecode) -> tuple[int | None, str]:
    """Loads bytecode into the machine.

    Returns:
      The bytecode's number for the FFI targets; or None, and a sentence that says why there is no machine. The number
      is a content hash: cached executables stay valid across processes.
    """
    chosen = machine(dtype)
    registered = register(chosen)
    library, reason = build.load(chosen.source)
    if library is None or not registered:
        return None, reason
    if isinstance(bytecode, BlockBytecode):
        lanes, blocks, layout = bytecode.shared, bytecode.code, bytecode.layout
    else:
        lanes, blocks, layout = (
            bytecode,
            np.zeros(0, np.int32),
            np.array([bytecode.num_registers, 0, 0, 0, 0, 0], np.int32),
        )
    digest = hashlib.sha256(chosen.lanes_handler.encode())
    for array in (lanes.code, blocks, lanes.constants, layout):
        digest.update(len(array).to_bytes(8) + array.tobytes())
    number = int.from_bytes(digest.digest()[:7])
    library.rewax_add_program(
        ctypes.c_int64(number), *_array(lanes.code), *_array(blocks), *_array(lanes.constants), _array(layout)[0]
    )
    return number, ""


def _array(numbers: np.ndarray) -> tuple[ctypes.c_void_p, ctypes.c_int64]:
    return numbers.ctypes.data_as(ctypes.c_void_p), ctypes.c_int64(len(numbers))


__all__ = ["Machine", "interpreted", "load", "machine", "register"]
