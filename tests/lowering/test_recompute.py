"""Functions with derivatives that evaluate them again: same values and derivatives, fewer equations."""

from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.lowering import interpreted, pointwise
from rewax.lowering.recompute import recomputed


class Inputs(NamedTuple):
    a: jax.Array
    b: jax.Array
    index: jax.Array
    power: float


def plain(inputs: Inputs, scale):
    """Uses an integer array, a Python number and everything else, nonlinearly."""
    picked = jnp.sin(inputs.b[inputs.index]) * scale
    return {"x": inputs.a * picked + inputs.a**inputs.power, "y": jnp.sum(inputs.a * inputs.b[0])}


FAST = recomputed(plain)


def arguments(*batch: int):
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.uniform(0.5, 1.5, (*batch, n))) for n in (4, 6))
    return Inputs(a, b, jnp.asarray([0, 2, 2, 5]), 3.0), jnp.asarray(rng.uniform(0.5, 1.5, batch))


def split(inputs, scale):
    """A function's arguments as those that have a derivative and those that have none."""
    return (inputs.a, inputs.b, scale), (inputs.index, inputs.power)


def of_real(function, rest):
    index, power = rest
    return lambda a, b, scale: function(Inputs(a, b, index, power), scale)


def everything(function, real, tangents, cotangent):
    value, tangent = jax.jvp(function, real, tangents)
    return value, tangent, jax.vjp(function, *real)[1](cotangent)


@pytest.mark.parametrize("compiled", [False, True])
def test_value_forward_and_reverse_equal_the_plain_function(x64, random_like, relative_error, compiled):
    real, rest = split(*arguments())
    tangents = random_like(0, real)
    cotangent = random_like(1, jax.eval_shape(of_real(plain, rest), *real))
    run = jax.jit(everything, static_argnums=0) if compiled else everything
    got, want = (run(of_real(f, rest), real, tangents, cotangent) for f in (FAST, plain))
    assert jax.tree.structure(got) == jax.tree.structure(want)
    assert relative_error(got, want) < 1e-14


@pytest.mark.parametrize("axes", [(0, 0, 0), (0, None, None), (None, 0, 0), (None, None, 0)])
def test_vmap_repeats_nothing_that_is_shared(x64, random_like, relative_error, axes):
    real, rest = split(*arguments(5))
    real = tuple(a if axis == 0 else a[0] for a, axis in zip(real, axes, strict=True))

    def batched(function):
        return jax.vmap(of_real(function, rest), axes)

    tangents, cotangent = random_like(0, real), random_like(1, jax.eval_shape(batched(plain), *real))
    got, want = (everything(batched(f), real, tangents, cotangent) for f in (FAST, plain))
    assert relative_error(got, want) < 1e-14
    (call,) = jax.make_jaxpr(batched(FAST))(*real).eqns
    (equation,) = call.params["call_jaxpr"].eqns
    assert equation.primitive.name == "linear_call"
    shapes = [v.aval.shape for v in equation.invars]
    for a in real:
        assert a.shape in shapes


def test_nested_vmap_of_a_gradient(x64, relative_error):
    inputs, scale = arguments(2, 3)

    def gradient(function):
        def one(a, b, scale):
            return jax.grad(lambda a: function(Inputs(a, b, inputs.index, inputs.power), scale)["x"].sum())(a)

        return jax.vmap(jax.vmap(one, (0, None, 0)), (0, 0, 0))(inputs.a, inputs.b[:, 0], scale)

    assert relative_error(gradient(FAST), gradient(plain)) < 1e-14


def test_a_scan_of_it_keeps_only_its_inputs(x64, relative_error):
    inputs, scale = arguments()

    def last(function, a):
        def body(a, _):
            return 0.3 * function(inputs._replace(a=a), scale)["x"], None

        return jax.lax.scan(body, a, length=6)[0].sum()

    got, want = (jax.grad(last, argnums=1)(f, inputs.a) for f in (FAST, plain))
    assert relative_error(got, want) < 1e-14
    jaxpr = jax.make_jaxpr(jax.grad(last, argnums=1), static_argnums=0)(FAST, inputs.a)
    stored = [v.aval.shape for e in jaxpr.eqns if e.primitive.name == "scan" for v in e.outvars]
    assert [s for s in stored if s[:1] == (6,)] == [(6, 4)]  # the six values of a, nothing of what is between


def test_numbers_do_not_promote():
    out = recomputed(lambda a, factor: a * factor)(jnp.ones(3, jnp.float16), 2.0)
    assert out.dtype == jnp.float16


def test_equal_numbers_of_different_types_are_different_programs():
    """1, 1.0 and True are equal and hash alike."""
    which = recomputed(lambda x, number: x * {int: 2.0, float: 3.0, bool: 5.0}[type(number)])
    assert [float(which(jnp.float32(1.0), number)) for number in (1, 1.0, True)] == [2.0, 3.0, 5.0]


def test_zeros_of_both_signs_are_different_programs():
    """They are equal and hash alike."""
    inverse = recomputed(lambda x, number: x / number)
    assert [float(inverse(jnp.float32(1.0), number)) for number in (0.0, -0.0)] == [np.inf, -np.inf]


def test_a_number_that_is_nan_is_one_program():
    traces, counts = [], []
    scaled = recomputed(lambda x, number: traces.append(1) or x * number)
    for _ in range(3):
        assert np.isnan(scaled(jnp.float32(1.0), float("nan")))
        counts.append(len(traces))
    assert counts[0] == counts[-1]


def test_second_derivatives_are_refused_with_the_reason():
    f = recomputed(jnp.sin)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.grad(jax.grad(f))(1.0 * jnp.ones(()))


def iterated(a, b):
    """The cube root of a, times b, by an iteration whose derivative nobody should take."""
    x = jax.lax.while_loop(
        lambda x: jnp.any(jnp.abs(x**3 - a) > 1e-14 * a), lambda x: x - (x**3 - a) / (3 * x**2), 2.0 + a
    )
    return {"root": x, "product": x * b}


def implicit(known, a, b):
    """The same, with the derivative of what solves x^3 = a."""
    x = jax.lax.stop_gradient(known["root"])
    x = x - (x**3 - a) / (3 * x**2)
    return {"root": x, "product": x * b}


def closed(a, b):
    return {"root": jnp.cbrt(a), "product": jnp.cbrt(a) * b}


SURROGATED = recomputed(iterated, derivative_of=implicit)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_surrogate_is_differentiated_instead(x64, random_like, relative_error, compiled):
    """Value of the function, derivatives of the derivative_of, forward and reverse, also under two vmaps."""
    rng = np.random.default_rng(0)
    real = tuple(jnp.asarray(rng.uniform(0.5, 9.0, (3, 4, 5))) for _ in range(2))
    tangents, cotangent = random_like(0, real), random_like(1, jax.eval_shape(closed, *real))
    run = jax.jit(everything, static_argnums=0) if compiled else everything
    want = run(closed, real, tangents, cotangent)
    assert relative_error(run(SURROGATED, real, tangents, cotangent), want) < 1e-13
    assert relative_error(run(jax.vmap(jax.vmap(SURROGATED)), real, tangents, cotangent), want) < 1e-13
    shared = run(
        jax.vmap(jax.vmap(SURROGATED, (0, None)), (0, None)),
        (real[0], real[1][0, 0]),
        (tangents[0], tangents[1][0, 0]),
        cotangent,
    )
    want = run(lambda a, b: closed(a, b), (real[0], real[1][0, 0]), (tangents[0], tangents[1][0, 0]), cotangent)
    assert relative_error(shared, want) < 1e-13


def test_the_function_runs_once_and_its_derivative_never(x64):
    """The iteration is in the program of a gradient once; without a derivative_of it could not be differentiated at all."""

    def loss(function, a):
        def body(a, _):
            return function(a, 0.5 * a)["product"], None

        return jnp.sum(jax.lax.scan(body, a, length=4)[0])

    a = jnp.array([2.0, 3.0])
    gradient = jax.jit(jax.grad(loss, argnums=1), static_argnums=0)
    want = jax.grad(loss, argnums=1)(closed, a)
    np.testing.assert_allclose(gradient(SURROGATED, a), want, rtol=1e-12)
    text = gradient.lower(SURROGATED, a).as_text()
    # Two scans (forward and back) and the iteration.
    assert text.count("stablehlo.while") == 3
    with pytest.raises(ValueError, match="while_loop"):
        gradient(recomputed(iterated), a)


def test_a_surrogate_sees_the_result_and_all_arguments(x64):
    """Wrong on purpose, to tell which is which: with derivatives of 3 x the result by a and none by b."""
    wrong = recomputed(lambda a, b: a * b, derivative_of=lambda known, a, b: 3.0 * jax.lax.stop_gradient(known) * a)
    value, (by_a, by_b) = jax.value_and_grad(wrong, argnums=(0, 1))(jnp.array(2.0), jnp.array(5.0))
    assert (float(value), float(by_a), float(by_b)) == (10.0, 30.0, 0.0)


def of_elements(function):
    many = pointwise(lambda shared, elements: function(elements))
    return lambda elements: many(None, elements)


@pytest.mark.parametrize("way", [recomputed, interpreted, of_elements])
def test_what_a_function_closes_over_is_read_again_after_clear_caches(way):
    law = {"names": ("a",), "factor": 2.0}
    function = way(lambda x: dict.fromkeys(law["names"], x * law["factor"]))

    def value_and_gradient():
        return jax.jit(lambda x: (function(x), jax.grad(lambda x: sum(function(x).values()).sum())(x)))(jnp.ones(3))

    value_and_gradient()
    law.update(names=("b", "c"), factor=3.0)
    jax.clear_caches()
    value, gradient = value_and_gradient()
    assert {name: float(a[0]) for name, a in value.items()} == {"b": 3.0, "c": 3.0}
    assert float(gradient[0]) == 6.0


@pytest.mark.parametrize("way", [recomputed, interpreted, of_elements])
@pytest.mark.parametrize(
    "around", [jax.grad, jax.jit, lambda f: jax.jit(jax.grad(f))], ids=["grad", "jit", "jit(grad)"]
)
def test_a_traced_value_from_outside_is_refused(way, around, recwarn):
    """It is no argument: compiled, its derivative would be zero in silence."""

    def loss(factor):
        return jnp.sum(way(lambda x: x * factor)(jnp.ones(3)))

    with pytest.raises(ValueError, match="<lambda> uses a traced value from outside: pass it as an argument"):
        around(loss)(2.0)
    assert not recwarn.list
    assert float(loss(2.0)) == 6.0


@flax.struct.dataclass
class Soft:
    k: jax.Array

    def force(self, x):
        return self.k * x


@flax.struct.dataclass
class Hard(Soft):
    def force(self, x):
        return 100.0 * self.k * x


@pytest.mark.parametrize("decorator", [recomputed, interpreted, pointwise])
def test_classes_with_the_same_fields_have_programs_of_their_own_outside_jit(decorator):
    force = decorator(lambda law, x: law.force(x))
    one, x = jnp.ones(()), jnp.array([0.25])
    for law, slope in ((Soft(one), 1.0), (Hard(one), 100.0)):
        assert force(law, x)[0] == 0.25 * slope
        assert jax.grad(lambda x, law=law: force(law, x).sum())(x)[0] == slope
        assert jax.vmap(lambda x, law=law: force(law, x))(x[None])[0, 0] == 0.25 * slope


@pytest.mark.parametrize("decorator", [recomputed, interpreted, pointwise])
def test_a_result_that_is_not_floating_point_has_a_value_and_a_derivative_is_refused(decorator):
    force = decorator(lambda k, x: (k * x, x > k))
    k, x = jnp.float32(0.5), jnp.array([0.25, 0.75], jnp.float32)
    assert force(k, x)[1].tolist() == [False, True]
    with pytest.raises(ValueError, match=r"is differentiated and has a result of type bool: return floating-point"):
        jax.grad(lambda k: force(k, x)[0].sum())(k)
