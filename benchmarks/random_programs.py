"""Random programs of small arrays: what ``rewax.lowering`` is compared with JAX on (fuzz_lowering.py).

A program is a list of steps, each an operation on earlier values. Floating-point values are exact (few significant
bits, so that no rounding decides) or rough. Operations that jump take exact ones only.
"""

import random
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

SHAPES = [(), (1,), (2,), (3,), (4,), (2, 3), (3, 3), (1, 4), (2, 2, 2)]
NICE = [0.0, 1.0, -1.0, 0.5, -0.5, 2.0, -2.0, 3.0, 1.5, -2.5, 4.0, 0.25]
EXTREME = [float("nan"), float("inf"), float("-inf"), -0.0]
MOST_BITS = 18


class Value(NamedTuple):
    """What is known of a value while a program is drawn."""

    shape: tuple[int, ...]
    kind: str
    """``f``, ``i`` or ``b``."""
    bits: int = 3
    """Significant bits of an exact number; more than ``MOST_BITS``: it is rough."""

    @property
    def size(self) -> int:
        return int(np.prod(self.shape))

    @property
    def exact(self) -> bool:
        return self.kind != "f" or self.bits <= MOST_BITS


Step = tuple[Callable[..., Any], tuple[int, ...]]


class RandomProgram(NamedTuple):
    """A program and what it takes."""

    inputs: list[Value]
    steps: list[Step]
    outputs: tuple[int, ...]
    names: list[str]

    def __call__(self, *args: Any) -> tuple[Any, ...]:
        values = list(args)
        for function, used in self.steps:
            values.append(function(*(values[i] for i in used)))
        return tuple(values[i] for i in self.outputs)


UNARY_SMOOTH = {
    "neg": jnp.negative, "sin": jnp.sin, "cos": jnp.cos, "tan": jnp.tan, "tanh": jnp.tanh, "exp": jnp.exp,
    "log": jnp.log, "sqrt": jnp.sqrt, "rsqrt": jax.lax.rsqrt, "cbrt": jnp.cbrt, "log1p": jnp.log1p,
    "expm1": jnp.expm1, "arctan": jnp.arctan, "arcsin": jnp.arcsin, "arccos": jnp.arccos, "sinh": jnp.sinh,
    "cosh": jnp.cosh, "arcsinh": jnp.arcsinh, "erf": jax.scipy.special.erf, "exp2": jnp.exp2,
    "logistic": jax.nn.sigmoid, "square": jnp.square, "cube": lambda a: a**3, "inverse": lambda a: a**-2,
    "reciprocal": lambda a: 1.0 / a, "abs": jnp.abs,
}  # fmt: skip
UNARY_JUMPS = {
    "floor": jnp.floor, "ceil": jnp.ceil, "round": jnp.round, "sign": jnp.sign, "is_finite": jnp.isfinite,
    "to_int": lambda a: a.astype(jnp.int32), "to_bool": lambda a: a.astype(bool), "isnan": jnp.isnan,
    "large_to_int": lambda a: (a * 2.0**30).astype(jnp.int32), "huge": lambda a: jnp.isfinite(a * 1e38),
    "near_to_int": lambda a: (a * 1073741760).astype(jnp.int32), "remainder": lambda a: a % 1.5,
    "rem": lambda a: jax.lax.rem(a, jnp.full_like(a, -0.75)),
}  # fmt: skip
BINARY = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "div": jnp.divide, "atan2": jnp.arctan2,
    "pow": lambda a, b: jnp.abs(a) ** jnp.clip(b, -2, 2), "hypot": lambda a, b: jnp.sqrt(a * a + b * b),
}  # fmt: skip
BINARY_EXACT = {
    "max": jnp.maximum, "min": jnp.minimum, "lt": jnp.less, "ge": jnp.greater_equal, "eq": jnp.equal,
    "ne": jnp.not_equal, "select": lambda a, b: jnp.where(a > 0, a, b), "clip": lambda a, b: jnp.clip(a, -1, b),
    "cond": lambda a, b: jax.lax.cond(jnp.sum(a) > 0, lambda: a, lambda: b * 2),
}  # fmt: skip
INTEGER = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "max": jnp.maximum, "div": jax.lax.div,
    "rem": jax.lax.rem, "and": jnp.bitwise_and, "or": jnp.bitwise_or, "xor": jnp.bitwise_xor, "lt": jnp.less,
    "floordiv": jnp.floor_divide, "mod": jnp.mod,
}  # fmt: skip
INTEGER_UNARY = {
    "neg": jnp.negative, "abs": jnp.abs, "not": jnp.bitwise_not, "sign": jnp.sign, "large": lambda a: a * 2**28,
    "square": lambda a: a**2, "to_float": lambda a: a.astype(float), "to_bool": lambda a: a.astype(bool),
}  # fmt: skip
BOOLEAN = {"and": jnp.logical_and, "or": jnp.logical_or, "xor": jnp.logical_xor, "eq": jnp.equal}
BOOLEAN_UNARY = {"not": jnp.logical_not, "to_float": lambda a: a.astype(float), "to_int": lambda a: a.astype(int)}
REDUCTIONS = {"sum": jnp.sum, "prod": jnp.prod, "max": jnp.max, "min": jnp.min}
CUMULATIVE = {
    "cumsum": jnp.cumsum, "cumprod": jnp.cumprod, "cummax": lambda a, axis: jax.lax.cummax(a, axis),
    "reverse": lambda a, axis: jax.lax.cumsum(a, axis, reverse=True),
}  # fmt: skip
PLACES = {"argmax": jnp.argmax, "argmin": jnp.argmin}
CONSTANTS = [0.0, 1.0, -1.0, 0.5, 2.0, -0.0, float("inf"), float("nan")]


def zeros_and_ones(rng: random.Random, shape: tuple[int, ...]) -> np.ndarray:
    return np.array([rng.choice([0.0, 0.0, 1.0, -1.0]) for _ in range(int(np.prod(shape)))]).reshape(shape)


def draw_program(rng: random.Random, *, num_steps: int = 12) -> RandomProgram:
    """A random program with at least one floating-point input and output.

    Args:
      rng: where all choices come from.
      num_steps: at most so many operations.
    """
    drawing = _Drawing(rng)
    for _ in range(rng.randint(1, num_steps)):
        drawing.step()
    return drawing.program()


class _Drawing:
    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.inputs = [Value(rng.choice(SHAPES), "f") for _ in range(rng.randint(1, 3))]
        if rng.random() < 0.2:
            self.inputs.append(Value(rng.choice(SHAPES), rng.choice("ib")))
        self.values = list(self.inputs)
        self.steps: list[Step] = []
        self.names: list[str] = []

    def program(self) -> RandomProgram:
        floats = [i for i, v in enumerate(self.values) if v.kind == "f"]
        outputs = tuple(sorted({floats[-1], *(self.rng.choice(floats) for _ in range(2))}))
        return RandomProgram(self.inputs, self.steps, outputs, self.names)

    def add(self, name: str, function: Callable[..., Any], *used: int, bits: int = 99) -> None:
        structs = [
            jax.ShapeDtypeStruct(v.shape, {"f": jnp.result_type(float), "i": jnp.int32, "b": bool}[v.kind])
            for v in (self.values[i] for i in used)
        ]
        out = jax.eval_shape(function, *structs)
        if out.size > 40:
            return
        kind = "f" if jnp.issubdtype(out.dtype, jnp.floating) else "b" if out.dtype == bool else "i"
        if kind == "i":
            inner = function
            function = lambda *a: inner(*a).astype(jnp.int32)  # noqa: E731
        self.steps.append((function, used))
        self.names.append(f"{name}{used}")
        self.values.append(Value(tuple(out.shape), kind, bits))

    def pick(self, kind: str, *, exact: bool = False, least_rank: int = 0) -> int | None:
        found = [
            i for i, v in enumerate(self.values)
            if v.kind == kind and (v.exact or not exact) and len(v.shape) >= least_rank and (v.size or not least_rank)
        ]  # fmt: skip
        return self.rng.choice(found[-6:]) if found else None

    def step(self) -> None:
        rng = self.rng
        ways = [self.unary, self.binary, self.binary, self.arrange, self.reduce, self.index, self.whole, self.contract]
        rng.choice(ways)()

    def unary(self) -> None:
        jumps = self.rng.random() < 0.3
        i = self.pick("f", exact=jumps)
        if i is not None:
            name = self.rng.choice(sorted(UNARY_JUMPS if jumps else UNARY_SMOOTH))
            keeps = jumps or name in ("neg", "abs")
            bits = self.values[i].bits if keeps else 99
            self.add(name, (UNARY_JUMPS if jumps else UNARY_SMOOTH)[name], i, bits=bits)

    def binary(self) -> None:
        rng, decides = self.rng, self.rng.random() < 0.35
        i = self.pick("f", exact=decides)
        if i is None:
            return
        a = self.values[i]
        mates = [
            k for k, v in enumerate(self.values) if v.kind == "f" and v.shape == a.shape and (v.exact or not decides)
        ]
        if rng.random() < 0.3:
            table, name = zeros_and_ones(rng, a.shape), rng.choice(["mul", "add", "sub", "div"])
            order = rng.random() < 0.5 and name != "div"
            function = BINARY[name]
            self.add(
                f"{name}_table",
                lambda a: (
                    function(jnp.asarray(table, a.dtype), a) if order else function(a, jnp.asarray(table, a.dtype))
                ),
                i,
                bits=a.bits + 1,
            )
            return
        if rng.random() < 0.2:
            constant, name = rng.choice(CONSTANTS), rng.choice(["mul", "add", "sub", "div"])
            function = BINARY[name]
            bits = a.bits + 1 if name != "div" or constant in (1.0, -1.0, 0.5, 2.0) else 99
            self.add(f"{name}_{constant}", lambda a: function(a, constant), i, bits=bits)
            return
        k = rng.choice(mates)
        name = rng.choice(sorted(BINARY_EXACT if decides else BINARY))
        b = self.values[k]
        bits = {"mul": a.bits + b.bits, "add": max(a.bits, b.bits) + 3, "sub": max(a.bits, b.bits) + 3}.get(name, 99)
        bits = max(a.bits, b.bits) + 1 if decides else bits
        self.add(name, (BINARY_EXACT if decides else BINARY)[name], i, k, bits=bits)

    def arrange(self) -> None:
        rng, i = self.rng, self.pick(self.rng.choice("ffi"), least_rank=1)
        if i is None:
            return
        v = self.values[i]
        rank = len(v.shape)
        order = tuple(rng.sample(range(rank), rank))
        axis, size = rng.randrange(rank), int(np.prod(v.shape))
        low, high, gap = rng.randint(-1, 2), rng.randint(-1, 2), rng.randint(0, 1)
        config = [(0, 0, 0)] * rank
        config[axis] = (low, high, gap)
        bound = rng.randrange(v.shape[axis])
        ways = {
            "transpose": lambda a: a.transpose(order),
            "ravel_f": lambda a: jnp.ravel(a, order="F"),
            "reshape_dimensions": lambda a: jax.lax.reshape(a, (size,), dimensions=order),
            "reshape_f": lambda a: jnp.reshape(a, (-1, 1), order="F"),
            "flip": lambda a: jnp.flip(a, axis),
            "pad": lambda a: jax.lax.pad(a, jnp.asarray(3, a.dtype), config),
            "roll": lambda a: jnp.roll(a, 1, axis),
            "slice": lambda a: jax.lax.slice_in_dim(a, bound, a.shape[axis], axis=axis),
            "stack": lambda a: jnp.stack([a, -a], axis),
            "concatenate": lambda a: jnp.concatenate([a, a], axis),
            "split": lambda a: jnp.split(a, [bound], axis)[rng_side],
            "broadcast": lambda a: jnp.broadcast_to(a[None], (2, *a.shape)),
            "squeeze": lambda a: a[..., None].squeeze(-1),
            "unstack": lambda a: jnp.unstack(a, axis=axis)[bound],
        }
        rng_side = rng.randint(0, 1)
        name = rng.choice(sorted(ways))
        if name == "pad" and v.shape[axis] + low + high + gap * (v.shape[axis] - 1) < 0:
            return
        self.add(name, ways[name], i, bits=max(v.bits, 3) if v.kind == "f" else 99)

    def reduce(self) -> None:
        rng = self.rng
        i = self.pick(rng.choice("fffi"), exact=True, least_rank=1)
        if i is None:
            return
        v = self.values[i]
        axis = rng.randrange(len(v.shape))
        table = rng.choice([REDUCTIONS, CUMULATIVE, PLACES])
        name = rng.choice(sorted(table))
        if v.shape[axis] == 0 and table is not CUMULATIVE and name not in ("sum", "prod"):
            return
        bits = v.bits * max(v.shape[axis], 1) if "prod" in name else v.bits + 3
        function = table[name]
        self.add(name, lambda a: function(a, axis=axis), i, bits=bits)

    def index(self) -> None:
        rng, i = self.rng, self.pick("f", least_rank=1)
        if i is None:
            return
        v = self.values[i]
        n = v.shape[0]
        places = np.array([rng.randint(-1, n + 1) for _ in range(rng.randint(1, 3))], np.int32)
        mode = rng.choice(["drop", "clip", "promise_in_bounds"])
        inside = np.clip(places, 0, max(n - 1, 0)).astype(np.int32)
        start = rng.randint(0, n)
        ways = {
            "take": lambda a: a.at[places].get(mode="fill" if mode == "drop" else "clip"),
            "take_filled": lambda a: a.at[places].get(mode="fill", fill_value=7.0),
            "set": lambda a: a.at[places].set(2.0, mode="drop"),
            "add": lambda a: a.at[inside].add(1.5),
            "multiply": lambda a: a.at[inside].multiply(0.0),
            "max": lambda a: a.at[inside].max(0.25),
            "min": lambda a: a.at[inside].min(0.25),
            "apply": lambda a: a.at[inside[:1]].apply(lambda b: b * b + 1.0),
            "dynamic_slice": lambda a: jax.lax.dynamic_slice_in_dim(a, start, max(n - 1, 0), 0),
            "update": lambda a: jax.lax.dynamic_update_slice_in_dim(a, a[: n // 2] * 2, start, 0),
            "scan": lambda a: jax.lax.scan(lambda c, x: (c + x.sum(), c - x), jnp.zeros((), a.dtype), a)[1],
            "scan_back": lambda a: jax.lax.scan(lambda c, x: (c * 0.5 + x, c), jnp.zeros_like(a[0]), a, reverse=True)[
                0
            ],
        }
        name = rng.choice(sorted(ways))
        if n == 0 or (name in ("max", "min", "apply", "scan", "scan_back") and not v.exact):
            return
        self.add(name, ways[name], i, bits=2 * v.bits + 4)

    def whole(self) -> None:
        kind = self.rng.choice("iib")
        i = self.pick(kind)
        if i is None:
            return
        if self.rng.random() < 0.4:
            table = INTEGER_UNARY if kind == "i" else BOOLEAN_UNARY
            name = self.rng.choice(sorted(table))
            self.add(f"{name}_{kind}", table[name], i, bits=99 if kind == "i" else 1)
            return
        mates = [k for k, v in enumerate(self.values) if v.kind == kind and v.shape == self.values[i].shape]
        table = INTEGER if kind == "i" else BOOLEAN
        name = self.rng.choice(sorted(table))
        self.add(f"{name}_{kind}", table[name], i, self.rng.choice(mates))

    def contract(self) -> None:
        rng, i = self.rng, self.pick("f", least_rank=1)
        if i is None:
            return
        v = self.values[i]
        rank, last = len(v.shape), v.shape[-1]
        table = zeros_and_ones(rng, (2, last))
        ways = {
            "dot_self": lambda a: jnp.vdot(a, a),
            "gram": lambda a: jnp.einsum("...i,...i->...", a, a),
            "table": lambda a: jnp.einsum("ki,...i->...k", jnp.asarray(table, a.dtype), a),
            "outer": lambda a: jnp.einsum("...i,...j->...ij", a, a),
            "matmul": lambda a: a @ jnp.swapaxes(a, -1, -2) if rank > 1 else a @ a,
        }
        name = rng.choice(sorted(ways))
        self.add(name, ways[name], i, bits=2 * v.bits + 3)


def draw_inputs(rng: random.Random, program: RandomProgram, batch: tuple[int, ...], extreme: float, dtype: Any) -> list:
    """Arrays for a program, each with leading axes of a batch; a share of the numbers is extreme."""

    def number(kind: str) -> Any:
        if kind == "b":
            return rng.random() < 0.5
        if kind == "i":
            return rng.choice(
                [0, 1, -1, 2, 3, -5, 7, 2**31 - 1, -(2**31)] if rng.random() < extreme else [0, 1, -1, 2, 5]
            )
        return rng.choice(EXTREME if rng.random() < extreme else NICE)

    types = {"f": dtype, "i": np.int32, "b": bool}
    return [
        np.array([number(v.kind) for _ in range(int(np.prod((*batch, *v.shape))))], types[v.kind]).reshape(
            *batch, *v.shape
        )
        for v in program.inputs
    ]
