"""Vectors cut into arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering.machine import machine, register
from rewax.lowering.splitting import split_vector

SHAPES = [(2, 3), (), (0, 4), (5,)]


@NEEDS_COMPILER
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_it_is_a_part_of_the_machine(dtype):
    assert register(machine(np.dtype(dtype)))


@NEEDS_COMPILER
def test_other_types_and_compiled_programs_agree():
    split = jax.jit(lambda vector: split_vector(vector, SHAPES))
    for dtype, handler in ((jnp.float32, "rewax_split_float"), (jnp.int32, None)):
        vector = jnp.arange(12).astype(dtype)
        text = split.lower(vector).as_text()
        assert ("rewax_split" in text) == (handler is not None) and (handler or "") in text
        np.testing.assert_array_equal(np.concatenate([np.ravel(a) for a in split(vector)]), vector)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_arrays_lie_one_after_the_other(batch):
    vectors = np.random.default_rng(0).normal(size=(*batch, 12)).astype(np.float32)
    program = lambda vector: split_vector(vector, SHAPES)  # noqa: E731
    for _ in batch:
        program = jax.vmap(program)
    found = jax.jit(program)(vectors)
    begin = 0
    for array, shape in zip(found, SHAPES, strict=True):
        size = int(np.prod(shape))
        np.testing.assert_array_equal(array, vectors[..., begin : begin + size].reshape((*batch, *shape)))
        begin += size


def test_derivatives(random_like):
    vector = jnp.arange(12.0)
    value, tangent = jax.jvp(lambda v: split_vector(v, SHAPES), (vector,), (2.0 * vector,))
    for of_tangent, of_value in zip(tangent, value, strict=True):
        np.testing.assert_array_equal(of_tangent, 2.0 * of_value)
    cotangents = random_like(0, value)
    (pulled,) = jax.vjp(lambda v: split_vector(v, SHAPES), vector)[1](cotangents)
    np.testing.assert_array_equal(pulled, np.concatenate([np.ravel(c) for c in cotangents]))


@pytest.mark.parametrize("size", [4, 7])
def test_a_vector_of_another_size_is_refused(size):
    with pytest.raises(ValueError, match=rf"^vector has shape \({size},\): give \(5,\), the total size of the shapes$"):
        split_vector(jnp.zeros(size), [(2,), (3,)])
