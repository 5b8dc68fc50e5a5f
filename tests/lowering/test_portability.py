"""Programs for other machines hold no call of C++."""

import jax
import jax.numpy as jnp
import numpy as np
from native_cases import NEEDS_COMPILER

from rewax.lowering import interpreted, pointwise, portable, split_vector


def program(x):
    a = interpreted(lambda x: jnp.sin(x) * x)(x)
    b, c = split_vector(pointwise(lambda s, e: e**2 + s)(1.0, a), [(2,), (2,)])
    return (b * c).sum()


X = jnp.arange(4.0)


@NEEDS_COMPILER
def test_a_compiled_program_holds_cpp_only_outside():
    step = jax.jit(jax.value_and_grad(program))
    here = step.lower(X).as_text()
    with portable():
        there = step.lower(X).as_text()
    assert "rewax_" in here and "rewax_" not in there


def test_what_is_exported_runs_anywhere():
    for function in (program, jax.grad(program)):
        exported = jax.export.export(jax.jit(function))(X)
        assert "rewax_" not in exported.mlir_module()
        again = jax.export.deserialize(exported.serialize())
        np.testing.assert_allclose(again.call(X), function(X), rtol=1e-5)
