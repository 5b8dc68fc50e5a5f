"""Programs as lists of operations: each once, in order, and nothing but arithmetic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics import straight_line as module
from rewax.physics.numerics.straight_line import Operation, UnsupportedError, straight_line

PYTHON = {
    "neg": np.negative,
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "max": np.maximum, "sqrt": np.sqrt, "gt": np.greater,
    "b_to_f": np.float64, "select": lambda which, yes, no: yes if which else no,
}  # fmt: skip


def evaluated(program, *args):
    """What the operations give, one after the other."""
    line = straight_line(jax.make_jaxpr(program)(*args), [True] * len(args))
    values = []
    for operation in line.operations:
        if operation.name == "input":
            argument, place = operation.constant
            values.append(np.ravel(args[argument])[place])
        elif operation.name == "constant":
            values.append(float(operation.constant) if operation.kind == "f" else operation.constant == "True")
        else:
            values.append(PYTHON[operation.name](*(values[o] for o in operation.operands)))
    return [[values[i] for i in output] for output in line.outputs]


def halving(x, y):
    return 0.5 * x + y


def arrays(a, b):
    """What changes the form of arrays, and sums over them."""
    rows = jnp.stack([a, 2.0 * b, jnp.flip(a)])
    padded = jnp.pad(rows.T[1:], ((1, 0), (0, 2)), constant_values=7.0)
    total, turns = jax.lax.scan(lambda c, x: (c + x[0], c * x), jnp.float32(1.0), rows, reverse=True)
    product = rows @ jnp.concatenate([a, b]).reshape(-1, 2)[:3]
    odd = jax.lax.reduce(
        (rows, -rows), (jnp.float32(1), jnp.float32(0)), lambda u, w: jax.tree.map(halving, u, w), (1,)
    )
    return (
        odd,
        padded,
        total,
        turns,
        product,
        jnp.where(rows > 0.5, rows.max(axis=0), rows[:, :1].sum()),
        jnp.unstack(rows)[1],
    )


def test_small_arrays():
    draw = np.random.default_rng(0)
    a, b = (draw.normal(size=3).astype(np.float32) for _ in range(2))
    for found, expected in zip(evaluated(arrays, a, b), jax.tree.leaves(arrays(a, b)), strict=True):
        np.testing.assert_allclose(found, np.ravel(expected), rtol=2e-6)


def test_an_operation_is_there_once():
    line = straight_line(jax.make_jaxpr(lambda a: (jnp.sqrt(a) * jnp.sqrt(a), 1.0 * a + 0.0))(jnp.ones(1)), [True])
    assert line.operations.count(Operation("sqrt", (0,), "f", False)) == 1
    assert line.outputs[1] == [0]


def test_what_all_elements_share():
    program = jax.make_jaxpr(lambda scale, a: (jnp.exp(scale) * a, jnp.exp(scale)))(1.0, jnp.ones(1))
    line = straight_line(program, [False, True])
    assert [o.shared for o in line.operations if o.name in ("exp", "mul")] == [True, False]


@pytest.mark.parametrize(
    ("program", "named"),
    [
        (lambda a: a.astype(jnp.float64).sum(), "floating types other than float32"),
        (lambda a: jnp.zeros(1), "results are of floating types other than float32"),
        (lambda a: a * a.astype(jnp.int64), "numbers of type int64"),
        (lambda a: a * (a.astype(jnp.int32) * 2), "mul of whole numbers"),
        (lambda a: a * ((a > 0) < (a > 1)), "lt of truth values"),
        (lambda a: jax.lax.reduce_window(a, jnp.float32(0), halving, (1,), (1,), "SAME"), "reduce"),
        (lambda a: a[:0].sum(), "nothing"),
        (lambda a: [jax.debug.print("{}", a), a][1], "without a result"),
        (lambda a: jnp.float32(1) * a.astype(jnp.int32) ** 2, "powers of whole numbers"),
        (lambda a: jax.lax.scan(lambda c, _: (c + 1, None), a, length=1000)[0], "loop of 1000 turns"),
    ],
)
def test_what_is_refused(x64, program, named):
    with pytest.raises(UnsupportedError, match=named):
        straight_line(jax.make_jaxpr(program)(jnp.ones(1, jnp.float32)), [True])


def test_a_result_of_another_shape_than_announced_is_refused(monkeypatch):
    """As an operation would have that a later version of JAX gives a new parameter."""
    monkeypatch.setitem(module._SHAPES, "reshape", lambda args, params, out: args[0])
    with pytest.raises(UnsupportedError, match="reshape in a form that is not known"):
        straight_line(jax.make_jaxpr(lambda a: jax.lax.reshape(a, (2, 2)))(jnp.ones(4)), [False])


def test_types_of_two_precisions_are_refused(x64):
    program = jax.make_jaxpr(lambda a, b: a + b)(jnp.ones(1, jnp.float32), jnp.ones(1))
    with pytest.raises(UnsupportedError, match="floating types"):
        straight_line(program, [True, True])


def test_constants_become_what_they_meet(x64):
    """Python's numbers are of double precision where a program of single precision uses them."""
    line = straight_line(
        jax.make_jaxpr(lambda a: jnp.clip(a, -1.0, 1.0) * jnp.where(a < 0, -1.0, 1.0).astype(a.dtype))(
            jnp.ones(1, jnp.float32)
        ),
        [True],
    )
    assert {o.kind for o in line.operations} == {"f", "b"}


def test_a_program_of_endless_arithmetic_is_refused(monkeypatch):
    monkeypatch.setattr(module, "_MOST_OPERATIONS", 10)
    with pytest.raises(UnsupportedError, match="more than 10 operations"):
        straight_line(jax.make_jaxpr(lambda a: sum(a**k for k in range(20)))(jnp.ones(1)), [True])
