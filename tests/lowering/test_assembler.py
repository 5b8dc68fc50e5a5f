"""Bytecode: few registers, large instructions, and results wherever they come from."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import kernels
from rewax.lowering.assembler import assemble_blocks
from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.instructions import INSTRUCTIONS, NUMBERS
from rewax.lowering.kernels import pointwise
from rewax.lowering.lane_assembler import assemble
from rewax.lowering.operations import UnsupportedError

FLOAT = np.dtype(np.float32)
NAMES = {number: name for name, number in NUMBERS.items()}
NUM_OPERANDS = {"constant": 2, "load_float": 3, "store": 3, "sum": 2, "sum_of_products": 3, "store_bool": 2}


def instructions(code):
    """Instructions and how often each run repeats them."""
    found, at = [], 0
    while at < len(code):
        name, times = NAMES[code[at]], int(code[at + 1])
        operands = NUM_OPERANDS[name] if isinstance(name, str) else 1 + len(INSTRUCTIONS[code[at]].operands)
        found.append((name, times))
        at += 2 + operands * times
    assert at == len(code)
    return found


def blocks(function, *shapes, shared=(), summed=(False,)):
    """Bytecode of a function of arrays (rows, 1) and of some that all elements share."""
    varies = [k not in shared for k in range(len(shapes))]
    traced = jax.make_jaxpr(function)(*(jnp.ones(shape) for shape in shapes))
    rows = [int(np.prod(shape)) for shape in shapes]
    return assemble_blocks(from_jaxpr(traced, varies), [a.dtype for a in traced.in_avals], rows, summed)


def test_few_registers_and_long_runs():
    """The register of a value that nobody needs any more is used again; products are parts of sums."""

    def chain(a):
        for _ in range(50):
            a = 0.5 * jnp.roll(a, 1) + a
        return a

    program = assemble(from_jaxpr(jax.make_jaxpr(chain)(jnp.ones(4)), [True]), [FLOAT])
    assert program.num_registers <= 10
    assert program.operands == (0,)
    runs, fused = instructions(program.code), ("add", ("mul", "f", "f"), "f")
    assert runs[-1] == ("store", 4)
    counts = Counter()
    for name, times in runs:
        counts[name] += times
    assert counts[fused] == 200
    assert set(counts) == {"constant", "load_float", "store", fused}


def test_what_all_elements_share_is_computed_once():
    program = blocks(lambda s, a: a * jnp.exp(s[0] * s[1]), (2,), (1, 1), shared=(0,))
    assert instructions(program.code) == [(("mul", "F", "f"), 1)] or instructions(program.code) == [
        (("mul", "f", "F"), 1)
    ]
    assert [name for name, _ in instructions(program.shared.code)] == ["load_float", ("mul", "f", "f"), ("exp", "f")]
    assert len(program.shared_registers) == 1


def test_a_value_with_two_users_is_computed_once():
    def function(a):
        product = a[0] * a[1]
        return jnp.stack([product + a[0], product - a[1]])

    counts = Counter()
    for name, times in instructions(blocks(function, (2, 1)).code):
        counts[name] += times
    assert counts == {("mul", "f", "f"): 1, ("add", "f", "f"): 1, ("sub", "f", "f"): 1}


def test_results_need_no_register():
    """They are computed where they shall lie: one register at most, the one for temporary values, is left."""
    program = blocks(lambda a: a * a + a, (3, 1))
    assert program.num_registers == 1
    assert program.inputs == tuple((0, row, 3, 4) for row in range(3)) == program.outputs


def test_a_sum_of_products_stores_no_product():
    program = blocks(lambda a, b: (a * b, jnp.exp(a)), (1, 1), (1, 1), summed=(True, False))
    assert sorted(map(str, dict(instructions(program.code)))) == ["('exp', 'f')", "sum_of_products"]
    assert program.num_sums == 1


def test_integers_are_not_returned():
    line = from_jaxpr(jax.make_jaxpr(lambda a: a.astype(int))(jnp.ones(1)), [True])
    with pytest.raises(UnsupportedError, match="returns integers"):
        assemble_blocks(line, [FLOAT], [1], [False])
    with pytest.raises(UnsupportedError, match="returns integers"):
        assemble(line, [FLOAT])


def test_an_operation_that_no_instruction_computes_is_refused():
    line = from_jaxpr(jax.make_jaxpr(lambda a: jnp.sign(a))(jnp.ones(1)), [True])
    operation = next(o for o in line.operations if o.name == "sign")
    place = line.operations.index(operation)
    line.operations[place] = operation._replace(name="unknown")
    with pytest.raises(UnsupportedError, match="unknown"):
        assemble(line, [FLOAT])


@NEEDS_COMPILER
@pytest.mark.parametrize("num", [1, 64, 600])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_results_wherever_they_come_from(monkeypatch, num, dtype):
    """Operands, what all elements share, constants, one value twice, booleans, integers that became numbers."""

    def refuse(which, *args):
        raise AssertionError(f"there is no bytecode for the {which}")

    def function(shared, elements):
        a, flags, integers = elements
        found = {
            "a": a,
            "shared": shared * shared + 0.0 * a,
            "constant": jnp.full_like(a, 2.5),
            "twice": (a * 3, a * 3),
        }
        found |= {
            "above": a > 0.5,
            "flags": flags,
            "always": jnp.full(a.shape, True),
            "used": jnp.where(a > 0.5, a, -a),
        }
        return found | {
            "integers": (integers + 1).astype(a.dtype),
            "picked": jnp.where(flags, integers, 7).astype(a.dtype),
        }

    monkeypatch.setattr(kernels, "_with_jax", refuse)
    draw = np.random.default_rng(num)
    a, flags, integers = draw.normal(size=(2, num)), draw.integers(0, 2, (2, num)), draw.integers(-9, 9, (2, num))
    with jax.enable_x64(dtype is np.float64):
        elements = (jnp.asarray(a, dtype), jnp.asarray(flags, bool), jnp.asarray(integers, np.int32))
        shared = jnp.asarray(3.0, dtype)
        found, expected = (jax.vmap(f, (None, 0))(shared, elements) for f in (pointwise(function), function))
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert jax.tree.map(lambda a: a.dtype, found) == jax.tree.map(lambda a: a.dtype, expected)


@NEEDS_COMPILER
@pytest.mark.parametrize("num", [3, 700])
def test_sums_wherever_their_terms_come_from(x64, monkeypatch, num):
    """Cotangents of what all elements share: of operands, of products, of terms without an element's numbers."""

    def refuse(which, *args):
        raise AssertionError(f"there is no bytecode for the {which}")

    monkeypatch.setattr(kernels, "_with_jax", refuse)
    a = jnp.asarray(np.random.default_rng(num).normal(size=num))

    def gradient(function):
        def total(shared):
            out = function(shared, a)
            return jnp.sum(out["sum"]) + jnp.sum(out["product"]) + jnp.sum(out["alone"])

        return jax.grad(total)({"x": 2.0, "y": 3.0, "z": 0.5})

    def function(shared, a):
        return {"sum": shared["x"] + a, "product": shared["y"] * a * jnp.sin(a), "alone": a + jnp.exp(shared["z"])}

    found, expected = gradient(pointwise(function)), gradient(function)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found, expected)
