"""Programs as lists of operations: each once, in order, and nothing but arithmetic."""

import re

import jax
import jax.numpy as jnp
import pytest
from operation_cases import assert_equal_to_jax

from rewax.lowering import from_jaxpr as module
from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.operations import UnsupportedError


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


def looped(a):
    return jax.lax.scan(lambda c, x: (c + x, c), jnp.float32(0), a)[1]


def chosen(a):
    return jax.lax.cond(a[0] > 0, jnp.sin, jnp.cos, a)


def without_result(a):
    jax.jit(lambda b: ())(a)
    return 2.0 * a


def partly_unused(a, b):
    order = jnp.argsort(a)
    _ = a[order], jnp.linalg.eigh(jnp.outer(a, b))
    return jax.jit(lambda a: a + b)(a)


def test_what_no_result_needs_is_left_out():
    """Unsupported operations, too, and what would be added to the program for them."""
    program = jax.make_jaxpr(partly_unused)(jnp.ones(3), jnp.ones(3))
    assert {"sort", "eigh"} <= set(re.findall(r"\w+", str(program)))
    assert [o.name for o in from_jaxpr(program, [True, True]).operations].count("add") == 3
    assert_equal_to_jax(partly_unused, 0)


def test_what_has_no_result_and_no_effect_is_nothing():
    program = jax.make_jaxpr(without_result)(jnp.ones(2))
    assert [e.primitive.name for e in program.eqns] == ["jit", "mul"]
    assert [o.name for o in from_jaxpr(program, [True]).operations].count("mul") == 2


def test_small_arrays():
    assert_equal_to_jax(arrays, 0)


def test_what_all_elements_share():
    program = jax.make_jaxpr(lambda scale, a: (jnp.exp(scale) * a, jnp.exp(scale)))(1.0, jnp.ones(1))
    line = from_jaxpr(program, [False, True])
    assert [o.shared for o in line.operations if o.name in ("exp", "mul")] == [True, False]


KEY = jax.random.key(0)


@pytest.mark.parametrize(
    ("program", "named"),
    [
        (lambda a: a.astype(jnp.float64).sum(), "floating types other than float32"),
        (lambda a: jnp.zeros(1), "results are of floating types other than float32"),
        (lambda a: a * a.astype(jnp.int64), "numbers of type int64"),
        (lambda a: a + jax.random.uniform(KEY, (1,), a.dtype), "numbers of type key<fry>"),
        (lambda a: a * ((a > 0) < (a > 1)), "lt of booleans"),
        (lambda a: jax.lax.reduce_window(a, jnp.float32(0), halving, (1,), (1,), "SAME"), "reduce"),
        (lambda a: jax.lax.reduce_max(a[:0], axes=(0,)), "max of nothing"),
        (lambda a: a[a.astype(jnp.int32)], "indices that depend"),
        (lambda a: jax.lax.while_loop(lambda c: c.sum() < 9, lambda c: c + 1, a), "operation while"),
        (lambda a: [jax.debug.print("{}", a), a][1], "without a result"),
        (lambda a: jax.lax.reduce_precision(a, 5, 10), "reduce_precision with exponent_bits=5"),
        (lambda a: jax.lax.exp(a, accuracy=jax.lax.AccuracyMode.HIGHEST), "exp with accuracy"),
        (lambda a: jax.lax.scan(lambda c, _: (c + 1, None), a, length=1000)[0], "loop of 1000 turns"),
    ],
)
def test_what_is_refused(x64, program, named):
    with pytest.raises(UnsupportedError, match=named):
        from_jaxpr(jax.make_jaxpr(program)(jnp.ones(1, jnp.float32)), [True])


def test_a_result_of_another_shape_than_announced_is_refused(monkeypatch):
    other = module.PRIMITIVES["reshape"]._replace(lower=lambda builder, eqn, args: args[0])
    monkeypatch.setitem(module.PRIMITIVES, "reshape", other)
    with pytest.raises(UnsupportedError, match="reshape in a form that is not known"):
        from_jaxpr(jax.make_jaxpr(lambda a: jax.lax.reshape(a, (2, 2)))(jnp.ones(4)), [False])


def test_a_parameter_that_is_not_known_is_refused(monkeypatch):
    """As a later version of JAX may add one that means something."""
    for name, program in (("reshape", lambda a: a.reshape(2, 2)), ("scan", looped), ("cond", chosen)):
        known = {
            "reshape": module.PRIMITIVES["reshape"].parameters,
            "scan": module._LOOP_PARAMETERS,
            "cond": {"branches"},
        }[name]
        with pytest.raises(UnsupportedError, match=f"{name} with the unknown parameter news"):
            module.known(name, dict.fromkeys([*known, "news"]), known)
        from_jaxpr(jax.make_jaxpr(program)(jnp.ones(4)), [False])


def test_types_of_two_precisions_are_refused(x64):
    program = jax.make_jaxpr(lambda a, b: a + b)(jnp.ones(1, jnp.float32), jnp.ones(1))
    with pytest.raises(UnsupportedError, match="floating types"):
        from_jaxpr(program, [True, True])


def test_constants_become_what_they_meet(x64):
    """Python's numbers are of double precision where a program of single precision uses them."""
    line = from_jaxpr(
        jax.make_jaxpr(lambda a: jnp.clip(a, -1.0, 1.0) * jnp.where(a < 0, -1.0, 1.0).astype(a.dtype))(
            jnp.ones(1, jnp.float32)
        ),
        [True],
    )
    assert {o.kind for o in line.operations} == {"f", "b"}


@pytest.mark.parametrize(
    ("constant", "decides"),
    [
        (1 + 1e-12, lambda constant: constant > 1.0),
        (1e300, jnp.isfinite),
        (2.0**24 + 1, lambda constant: constant.astype(jnp.int32) > 2**24),
    ],
)
def test_constants_of_another_precision_take_no_decisions(x64, constant, decides):
    """Rounded to single precision they would decide otherwise."""
    constant = jnp.asarray(constant)
    program = jax.make_jaxpr(lambda a: jnp.where(decides(constant), a, -a))(jnp.ones(1, jnp.float32))
    with pytest.raises(UnsupportedError, match="floating types"):
        from_jaxpr(program, [True])


def test_a_program_of_endless_arithmetic_is_refused():
    with pytest.raises(UnsupportedError, match="more than 10 operations"):
        from_jaxpr(jax.make_jaxpr(lambda a: sum(a**k for k in range(20)))(jnp.ones(1)), [True], most=10)


def over_axes(a, b):
    """Sums, products of batches, running sums, and the indices of extremes."""
    cube = a[:, None, None] * b[None, :, None] - jnp.stack([a, b])[None].mT
    return (
        jnp.einsum("ijk,ijl->ilk", cube, cube),
        jnp.arange(6).reshape(3, 2) @ jnp.stack([a, b]),
        jnp.cumsum(cube, axis=1),
        jax.lax.cumsum(cube, axis=0, reverse=True),
        jax.nn.one_hot(jnp.argmax(cube, axis=1), 3),
        1.0 * jnp.argmax(cube[:0], axis=1),
        1.0 * jnp.argmin(jnp.concatenate([a, -a, -a])),
        a[:0].sum() + jnp.prod(a[:0]),
        *jnp.split(cube, [1, 2]),
    )


def test_sums_and_places_over_axes():
    assert_equal_to_jax(over_axes, 1)
