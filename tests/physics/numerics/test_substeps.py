"""Loops over substeps: storing less changes no number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.lowering.recompute import recomputed
from rewax.physics.numerics.substeps import both_ends, scan_substeps


def run(store_every, x):
    body = recomputed(lambda carry, interval: jnp.sin(carry) + interval[0] * interval[1])
    return scan_substeps(body, x, both_ends(jnp.arange(7.0)), store_every)


@pytest.mark.parametrize("store_every", [1, 2, 6])
def test_what_is_stored_changes_neither_value_nor_gradient(store_every):
    every, few = (jax.value_and_grad(lambda x, k=k: run(k, x))(0.3) for k in (None, store_every))
    np.testing.assert_allclose(every, few, rtol=1e-6)


@pytest.mark.parametrize("store_every", [0, 4])
def test_a_number_that_does_not_divide_the_substeps_is_refused(store_every):
    with pytest.raises(ValueError, match="give an integer that divides the 6 substeps"):
        run(store_every, jnp.float32(0.3))
