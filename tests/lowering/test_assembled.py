"""Sums over the elements of a mesh: the numbers and derivatives of JAX, from the machine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import assembled as module
from rewax.lowering.assembled import assembled, at_elements
from rewax.lowering.report import recorded
from rewax.lowering.stencils import Listed, Stencil

VERTICES, CORNERS = 23, 3


@pytest.fixture
def machine_only(monkeypatch):
    """What the machine cannot run fails, instead of being computed with JAX."""

    def refuse(which, *args):
        raise AssertionError(f"there is no bytecode for the {which}")

    monkeypatch.setattr(module, "_with_jax", refuse)


def pull(shared, given):
    """Five fields, of which elements read some at some corners; results at all corners."""
    (size, rows), at = given
    a, b = at[0]["a"] - at[1]["a"], at[2]["b"] * shared["scale"] ** shared["exponent"]
    c = jnp.where(at[1]["c"][0] > 0, at[1]["c"][1] * a, at[0]["c"][2] + rows[0] * rows[1])
    each = (size * a * b, jnp.sin(c) * size)
    return each, (-each[0], b * rows[0]), (c, each[1] - a)


FAST = assembled(pull)


def elements(count, listed=False):
    indices = np.random.default_rng(count).integers(0, VERTICES, (count, CORNERS))
    if not listed:
        return Stencil(indices, VERTICES)
    return Listed(jnp.asarray(indices.T, np.int32), jnp.int32(listed), VERTICES)


def arguments(count, *batch, dtype=np.float64):
    draw = np.random.default_rng(count)

    def some(*shape):
        return jnp.asarray(draw.uniform(0.5, 1.5, (*batch, *shape)), dtype)

    shared = {"scale": jnp.asarray(0.7, dtype), "exponent": 2}
    fields = {"a": some(VERTICES), "b": some(VERTICES), "c": tuple(some(VERTICES) - 1.0 for _ in range(3))}
    return shared, (some(count), some(2, count)), fields


def plain(of, shared, own, fields):
    """The same with JAX; of a list only its elements."""
    if isinstance(of, Stencil):
        indices = jnp.asarray(of.indices.T)
    else:
        indices, own = of.corners[:, : int(of.count)], jax.tree.map(lambda a: a[..., : int(of.count)], own)
    at = tuple(jax.tree.map(lambda a, k=k: a[k], fields) for k in indices)
    results = pull(shared, (own, at))
    zero = jnp.zeros(VERTICES, fields["b"].dtype)
    return jax.tree.map(lambda *r: sum(zero.at[k].add(a) for k, a in zip(indices, r, strict=True)), *results)


def everything(function, of, shared, own, fields, random_like):
    def real(scale, own, fields):
        return function(of, {**shared, "scale": scale}, own, fields)

    args = (shared["scale"], own, fields)
    tangents, cotangents = random_like(0, args), random_like(1, jax.eval_shape(real, *args))

    @jax.jit
    def all_three(args, tangents, cotangents):
        value, tangent = jax.jvp(real, args, tangents)
        return value, tangent, jax.vjp(real, *args)[1](cotangents)

    return all_three(args, tangents, cotangents)


@NEEDS_COMPILER
@pytest.mark.parametrize(
    ("count", "listed"), [(1, 0), (13, 0), (2 * 1024 + 37, 0), (40, 7), (40, 40), (40, 1), (1200, 600)]
)
def test_value_forward_and_reverse_are_those_of_jax(x64, machine_only, random_like, relative_error, count, listed):
    """Fewer elements than a vector has, more than a thread computes at a time, and lists that are not full."""
    given = (elements(count, listed), *arguments(count), random_like)
    found, expected = (everything(f, *given) for f in (FAST, plain))
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    assert relative_error(found, expected) < 1e-12


@NEEDS_COMPILER
def test_an_empty_list_gives_zeros_and_a_crowded_one_all_its_entries(x64, machine_only, random_like):
    given = (*arguments(40), random_like)
    empty = everything(FAST, elements(40, 1)._replace(count=jnp.int32(0)), *given)
    assert all(not np.any(a) for a in jax.tree.leaves(empty))
    full, crowded = (everything(FAST, elements(40, count), *given) for count in (40, 99))
    jax.tree.map(np.testing.assert_array_equal, full, crowded)


@NEEDS_COMPILER
def test_sums_are_in_the_order_of_jax_to_the_bit(machine_only):
    """With results that are single numbers, only the order of sums can differ."""

    @assembled
    def same(shared, given):
        return tuple(3.0 * a for a in given[1])

    of, field = elements(500), jnp.asarray(np.random.default_rng(0).normal(size=VERTICES), np.float32)
    flat = np.ascontiguousarray(of.indices.T).reshape(-1)
    expected = jnp.zeros(VERTICES, np.float32).at[flat].add(3.0 * field[flat])
    np.testing.assert_array_equal(same(of, (), (), field), expected)


@NEEDS_COMPILER
@pytest.mark.parametrize("form", [assembled, at_elements])
def test_one_field_of_single_numbers(x64, machine_only, random_like, relative_error, form):
    """With and without sums at the vertices."""

    def apart(shared, given):
        own, at = given
        each = shared * jnp.sin(own * at[0]) * at[2]
        return (each, at[1] * own, -each) if form is assembled else each

    def plain(of, shared, own, field):
        each = apart(shared, (own, [field[k] for k in of.indices.T]))
        if form is at_elements:
            return each
        return sum(jnp.zeros_like(field).at[k].add(e) for k, e in zip(of.indices.T, each, strict=True))

    of, (shared, (own, _), fields) = elements(700), arguments(700)
    args = (shared["scale"], own, fields["a"])
    tangents = random_like(0, args)

    def all_of(function):
        value, tangent = jax.jvp(lambda *a: function(of, *a), args, tangents)
        return value, tangent, jax.vjp(lambda *a: function(of, *a), *args)[1](jnp.cos(value))

    assert relative_error(all_of(form(apart)), all_of(plain)) < 1e-13


@NEEDS_COMPILER
def test_results_that_all_elements_share(machine_only):
    of, field = elements(13), jnp.ones(VERTICES, np.float32)

    def shared_by_corners(size, given):
        return (size, 2.0 * size, size)

    np.testing.assert_array_equal(at_elements(lambda size, given: size)(of, 3.0, (), field), jnp.full(13, 3.0))
    expected = sum(jnp.zeros_like(field).at[k].add(n) for k, n in zip(of.indices.T, (3.0, 6.0, 3.0), strict=True))
    np.testing.assert_array_equal(assembled(shared_by_corners)(of, 3.0, (), field), expected)


@NEEDS_COMPILER
@pytest.mark.parametrize("listed", [0, 30])
def test_environments_are_their_own(x64, machine_only, listed):
    """One alone has the bits that it has among others, of which one is not finite."""
    count, of = 1500, elements(1500, listed)
    shared, own, fields = arguments(count, 5, dtype=np.float32)
    fields["a"] = fields["a"].at[1].set(jnp.nan)

    def gradient(scale, own, fields):
        out, back = jax.vjp(lambda *a: FAST(of, {**shared, "scale": a[0]}, *a[1:]), scale, own, fields)
        return out, back(jax.tree.map(jnp.ones_like, out))

    together = jax.vmap(gradient, in_axes=(None, 0, 0))(shared["scale"], own, fields)
    for i in (0, 4):
        alone = gradient(shared["scale"], *jax.tree.map(lambda a, i=i: a[i], (own, fields)))
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            assert np.isfinite(b).all()
            np.testing.assert_array_equal(a[i], b)


@NEEDS_COMPILER
def test_lists_that_differ_between_environments(x64, machine_only, relative_error):
    shared, own, fields = arguments(40)
    lists = [elements(40, n) for n in (3, 40, 17)]
    corners = jnp.stack([(e.corners + i) % VERTICES for i, e in enumerate(lists)])
    counts = jnp.stack([e.count for e in lists])
    together = jax.vmap(lambda c, n: FAST(Listed(c, n, VERTICES), shared, own, fields))(corners, counts)
    for i in range(3):
        alone = plain(Listed(corners[i], counts[i], VERTICES), shared, own, fields)
        assert relative_error(jax.tree.map(lambda a, i=i: a[i], together), alone) < 1e-13


def test_what_does_not_fit_together_is_left_to_jax(x64, relative_error):
    of, (shared, own, fields) = elements(13), arguments(13)
    mixed = {**fields, "b": fields["b"].astype(np.float32)}
    with pytest.warns(match="not arrays of their number and of one floating type"):
        found = FAST(of, shared, own, mixed)
    assert relative_error(found, plain(of, shared, own, mixed)) < 1e-6


def test_fields_of_another_length_are_left_to_jax(x64, relative_error):
    """The machine reads num_vertices numbers of each."""
    of, (shared, own, fields) = elements(13), arguments(13)
    for other in (jax.tree.map(lambda a: jnp.concatenate([a, a]), fields), jax.tree.map(lambda a: a[:-9], fields)):
        assert relative_error(FAST(of, shared, own, other), plain(of, shared, own, other)) < 1e-13


def test_without_cpp_the_numbers_are_the_same(x64, monkeypatch, random_like, relative_error):
    given = (elements(50), *arguments(50), random_like)
    monkeypatch.setenv("REWAX_NATIVE", "0")
    assert relative_error(everything(FAST, *given), everything(plain, *given)) < 1e-12


@pytest.mark.parametrize("native", ["0", "1"])
def test_a_number_has_the_precision_of_the_fields_with_and_without_cpp(native, monkeypatch):
    monkeypatch.setenv("REWAX_NATIVE", native)
    inverse = at_elements(lambda nu, given: given[1][0]["x"] / (1.0 - 2.0 * nu))
    found = inverse(elements(5), 0.4999999, (), {"x": jnp.ones(VERTICES)})
    assert float(found[0]) == 1.0 / (1.0 - 2.0 * np.float32(0.4999999))


@NEEDS_COMPILER
@pytest.mark.parametrize("kind", [np.int32, bool])
def test_fields_that_are_no_floats_are_left_to_jax(kind, x64):
    """The machine would read them as floats."""
    of, x = elements(5), jnp.linspace(0.5, 1.5, VERTICES)
    weights = jnp.arange(VERTICES).astype(kind)
    weighted = at_elements(lambda shared, given: given[1][0]["x"] * given[1][1]["k"])
    with recorded() as decisions:
        found = weighted(of, (), (), {"x": x, "k": weights})
    np.testing.assert_allclose(found, x[of.indices[:, 0]] * weights[of.indices[:, 1]])
    assert ["one floating type" in d.reason for d in decisions] == [True]


@NEEDS_COMPILER
def test_a_list_of_long_integers_is_read_as_it_is(x64, machine_only):
    of, (shared, own, fields) = elements(6, listed=4), arguments(6)
    wide = Listed(of.corners.astype(np.int64), of.count.astype(np.int64), VERTICES)
    jax.tree.map(np.testing.assert_array_equal, FAST(wide, shared, own, fields), FAST(of, shared, own, fields))
