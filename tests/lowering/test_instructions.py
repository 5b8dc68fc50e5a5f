"""Instructions: the numbers of JAX, at ordinary arguments and at the others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import kernels as module
from rewax.lowering.instructions import BY_NAME, COMMUTATIVE, INSTRUCTIONS, TEXT, cases
from rewax.lowering.kernels import pointwise
from rewax.lowering.operations import ARITHMETIC


def test_every_operation_can_be_written():
    assert set(TEXT) >= ARITHMETIC


def test_each_instruction_is_found_by_its_last_operation():
    assert sorted(number for numbers in BY_NAME.values() for number in numbers) == list(range(len(INSTRUCTIONS)))
    assert all(INSTRUCTIONS[number].expression[0] == name for name, numbers in BY_NAME.items() for number in numbers)
    assert set(BY_NAME) >= COMMUTATIVE


def test_each_instruction_has_its_own_case():
    lines = cases().splitlines()
    assert [int(line.split()[1].strip(":")) for line in lines] == list(range(len(INSTRUCTIONS)))
    (number,) = [k for k, i in enumerate(INSTRUCTIONS) if i.expression == ("sub", ("mul", "f", "f"), ("mul", "f", "f"))]
    assert "((a0 * a1) - (a2 * a3))" in lines[number] and "REPEAT(5)" in lines[number]


@NEEDS_COMPILER
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_operations(x64, monkeypatch, dtype):
    """Each of them, at ordinary numbers and at the others."""

    def refuse(*args):
        raise AssertionError("there is no bytecode")

    monkeypatch.setattr(module, "_with_jax", refuse)
    info = np.finfo(dtype)
    special = [
        0.0,
        -0.0,
        np.inf,
        -np.inf,
        np.nan,
        info.tiny,
        info.tiny / 8,
        info.max,
        -info.max,
        88.9,
        -88.9,
        -103.0,
        1.0,
    ]
    x = np.concatenate([special, np.random.default_rng(0).normal(size=300) * 3, np.logspace(-30, 30, 100)]).astype(
        dtype
    )
    y = np.roll(x, 7)
    unary = {
        "abs": jnp.abs, "sign": jnp.sign, "neg": jnp.negative, "sqrt": jnp.sqrt, "rsqrt": jax.lax.rsqrt, "exp": jnp.exp,
        "log": jnp.log, "log1p": jnp.log1p, "expm1": jnp.expm1, "cbrt": jnp.cbrt, "tanh": jnp.tanh, "floor": jnp.floor,
        "ceil": jnp.ceil, "is_finite": jnp.isfinite, "logistic": jax.nn.sigmoid, "cube": lambda a: a**3,
        "sin": lambda a: jnp.sin(jnp.clip(a, -20.0, 20.0)), "cos": lambda a: jnp.cos(jnp.clip(a, -20.0, 20.0)),
        "not": lambda a: ~(a > 0),
        "inverse": lambda a: a**-2, "clip": lambda a: jnp.clip(a, -1.0, 1.0), "integer": lambda a: (2 * a).astype(jnp.int32),
    }  # fmt: skip
    binary = {
        "max": jnp.maximum, "min": jnp.minimum, "div": jnp.divide, "lt": jnp.less, "le": jnp.less_equal,
        "eq": jnp.equal, "ne": jnp.not_equal, "gt": jnp.greater, "ge": jnp.greater_equal,
        "xor": lambda a, b: (a > 0) ^ (b > 0), "or": lambda a, b: (a > 0) | (b > 1), "atan2": jnp.arctan2,
        "most": lambda a, b: jnp.maximum(a > 0, b > 1), "least": lambda a, b: jnp.minimum(a > 0, b > 1),
        "and": lambda a, b: (a > 0) & (b > 1), "pow": lambda a, b: jnp.abs(a) ** jnp.clip(b, -3.0, 3.0),
    }  # fmt: skip

    def all_of_them(shared, elements):
        a, b = elements
        found = {name: f(a) for name, f in unary.items()} | {name: f(a, b) for name, f in binary.items()}
        return {name: value.astype(a.dtype) for name, value in found.items()}

    args = ((), (jnp.asarray(x), jnp.asarray(y)))
    found, expected = pointwise(all_of_them)(*args), jax.jit(all_of_them)(*args)
    for name, want in expected.items():
        got, want = np.asarray(found[name]), np.asarray(want)
        if name in ("log", "sqrt", "rsqrt", "cbrt", "sign", "log1p"):  # XLA takes the smallest numbers for zero
            kept = (np.abs(x) >= info.tiny) | (x == 0)
            got, want = got[kept], want[kept]
        got, want = (np.where(np.abs(a) < 4 * info.tiny, 0, a) for a in (got, want))  # and makes them zero
        eps = (100 if name in ("cbrt", "log1p", "sin", "cos") else 8) * info.eps
        np.testing.assert_allclose(got, want, rtol=eps, atol=eps if name in ("sin", "cos") else 0, err_msg=name)
