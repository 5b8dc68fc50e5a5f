"""The fusion boundary is the identity, for every value, in both modes and under vmap; what it is for happens."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.lowering.fusion import compute_once, materialize, stored


def half_and_half(tree):
    """The first leaf once, the others fast."""
    leaves, treedef = jax.tree.flatten(tree)
    once, fast = stored(leaves[0], leaves[1:])
    return jax.tree.unflatten(treedef, [once, *fast])


BOTH = pytest.mark.parametrize("boundary", [materialize, compute_once, half_and_half])


def tree(first):
    return {"a": jnp.array([first, 1.5, -2.0, jnp.nan]), "b": (jnp.arange(6.0).reshape(2, 3), jnp.float32(7.0))}


@BOTH
@pytest.mark.parametrize("first", [0.0, np.nan, np.inf, -np.inf, -3e38])
def test_identity_bit_for_bit(boundary, first):
    """Also where the number that the loop's condition looks at is not finite."""
    t = tree(first)
    for f in (boundary, jax.jit(boundary)):
        jax.tree.map(np.testing.assert_array_equal, f(t), t)


@BOTH
def test_derivative_is_the_identity(boundary, random_like):
    t = tree(2.0)
    tangent, cotangent = random_like(0, t), random_like(1, t)
    jax.tree.map(np.testing.assert_array_equal, jax.jvp(boundary, (t,), (tangent,))[1], tangent)
    (back,) = jax.jit(lambda ct: jax.vjp(boundary, t)[1](ct))(cotangent)
    jax.tree.map(np.testing.assert_array_equal, back, cotangent)


@BOTH
def test_vmap_of_one_leaf_of_two(boundary):
    a, b = jnp.arange(12.0).reshape(3, 4), jnp.arange(4.0)
    got_a, got_b = jax.vmap(lambda a: boundary((a, b)))(a)
    np.testing.assert_array_equal(got_a, a)
    np.testing.assert_array_equal(got_b, np.broadcast_to(b, (3, 4)))
    gradient = jax.grad(lambda b: jnp.sum(jax.vmap(lambda a: jnp.prod(jnp.stack(boundary((a, b)))))(a)))(b + 1.0)
    expected = jax.grad(lambda b: jnp.sum(jax.vmap(lambda a: jnp.prod(jnp.stack((a, b))))(a)))(b + 1.0)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)


@BOTH
def test_a_chain_is_computed_once_and_not_in_each_of_its_users(boundary):
    """XLA copies a sine to four users that read it in different orders. Behind a boundary there is one, and the loop's
    condition has one."""
    x = jnp.linspace(0.0, 1.0, 4096).reshape(64, 64)

    def sines(store) -> int:
        def users(x):
            y = store(jnp.sin(x))
            return y[::-1] - x, y[:, ::-1] * x, y.T + x, y[::-1, ::-1] / x

        return jax.jit(users).lower(x).compile().as_text().count(" sine(")

    assert sines(boundary) <= 2 and sines(lambda a: a) >= 4


@BOTH
def test_each_of_several_arrays_is_computed_once(boundary):
    """Arrays of equal shape are rotated in the empty loop. Otherwise the compiler would remove it."""
    x = jnp.linspace(0.0, 1.0, 4096).reshape(64, 64)

    def sines(store) -> int:
        def users(x):
            a, b = store((jnp.sin(x), jnp.sin(2.0 * x)))
            return a[::-1] - b, a[:, ::-1] * b, a.T + b, b.T - a

        return jax.jit(users).lower(x).compile().as_text().count(" sine(")

    assert sines(boundary) <= 3 and sines(lambda arrays: arrays) >= 5


def test_users_of_a_number_rounded_down_see_one_and_the_same():
    """Integer part and rest add up to the number, although it lies on the edge between two integers.

    Computed once more for the scatter, with a product and a sum rounded as one, the integer part may be the next one: then the
    sum is off by 1.
    """
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.uniform(low, high, 4096), jnp.float32) for low, high in ((0.2, 0.8), (-1.0, 1.0)))
    edge = 0.1 * (rng.integers(2, 10, 4096) + 0.5)
    c = jnp.asarray(edge - np.float64(a) * np.float64(b), jnp.float32)
    table = jnp.arange(16, dtype=jnp.float32)

    @jax.jit
    def split(a, b, c):
        number = (a * b + c) * 10.0
        integer = compute_once(jnp.floor(number - 0.5).astype(jnp.int32))
        rest = number - integer
        return number, table[integer] + rest, table.at[integer].add(rest), jnp.sum(table) + jnp.sum(rest)

    number, again, gathered, total = split(a, b, c)
    np.testing.assert_allclose(again, number, atol=1e-5)
    np.testing.assert_allclose(jnp.sum(gathered), total, rtol=1e-5)


def test_on_a_gpu_speed_costs_nothing_and_correctness_a_barrier():
    def program(boundary):
        exported = jax.export.export(jax.jit(lambda x: boundary(2.0 * x) + 1.0), platforms=["cuda"])
        return exported(jax.ShapeDtypeStruct((3,), jnp.float32)).mlir_module()

    assert "while" not in program(materialize) and "optimization_barrier" not in program(materialize)
    assert "while" not in program(compute_once) and "optimization_barrier" in program(compute_once)
    both = program(lambda y: sum(jax.tree.leaves(stored(y, (y + 2.0, y + 3.0)))))
    barriers = [line.count("tensor<") for line in both.splitlines() if "stablehlo.optimization_barrier" in line]
    assert "while" not in both and barriers == [1]


@pytest.mark.parametrize("boundary", [materialize, compute_once])
def test_empty_arrays_are_handed_on(boundary):
    none, some = jnp.zeros((2, 0)), jnp.arange(3.0)
    for tree in ((none, some), (none,), ()):
        jax.tree.map(np.testing.assert_array_equal, jax.jit(boundary)(tree), tree)
    np.testing.assert_array_equal(jax.grad(lambda x: jnp.sum(boundary((none, x))[1] ** 2))(some), 2.0 * some)


@pytest.mark.parametrize("boundary", [materialize, compute_once])
def test_integers_beside_numbers_have_no_derivative(boundary):
    def inside(x):
        y, cell = boundary((x * x, jnp.floor(x).astype(jnp.int32)))
        return (y * cell).sum()

    x = jnp.array([1.5, 2.5])
    for f in (inside, jax.jit(inside)):
        np.testing.assert_allclose(jax.grad(f)(x), 2.0 * x * jnp.floor(x))
