"""Corners of elements and sums at vertices: transposed, and in the order that the machine keeps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.lowering import stencils
from rewax.lowering.stencils import Listed, Stencil

STENCIL = Stencil(np.asarray([[0, 1, 2], [2, 1, 3], [4, 0, 2]]), 6)


def test_a_list_of_all_elements_is_the_stencil():
    a, b = jnp.arange(6.0), jnp.arange(6.0) ** 2
    listed = Listed(jnp.asarray(STENCIL.indices.T), jnp.int32(3), 6)
    found, expected = stencils.gather_listed(listed, (a, b)), stencils.gather(STENCIL, (a, b))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(expected[2], [1.0, 1.0, 0.0])  # the first field at the second corner
    np.testing.assert_array_equal(stencils.assemble_listed(listed, found), stencils.assemble(STENCIL, found))


def test_sums_are_the_transpose_of_corners():
    a = (jnp.arange(6.0), jnp.ones(6))
    at, pull = jax.vjp(lambda a: stencils.gather(STENCIL, a), a)
    each = tuple(jnp.arange(3.0) + k for k in range(len(at)))
    np.testing.assert_array_equal(pull(each)[0], stencils.assemble(STENCIL, each))
    assert float(sum(map(jnp.vdot, at, each))) == float(sum(map(jnp.vdot, a, pull(each)[0])))


@pytest.mark.parametrize("seed", range(3))
def test_entries_are_the_corners_at_each_vertex_by_corner_and_element(seed):
    indices = np.random.default_rng(seed).integers(0, 7, (20, 4))
    starts, entries = Stencil(indices, 9).entries
    for vertex in range(9):
        own = entries[starts[vertex] : starts[vertex + 1]]
        assert (np.diff(own) > 0).all()
        np.testing.assert_array_equal(own, [20 * k + e for k in range(4) for e in range(20) if indices[e, k] == vertex])


@pytest.mark.parametrize("counts", [(3, 0), (2, 7)])  # more than the list holds: all entries are elements
def test_entries_beyond_the_last_element_add_nothing_in_either_direction(counts):
    corners, a = jnp.tile(STENCIL.indices.T, (2, 1, 1)), jnp.arange(12.0).reshape(2, 6)
    values = tuple(jnp.full((2, 3), 1.0 + k) for k in range(3))

    def sums(corners, count, values):
        return stencils.assemble_listed(Listed(corners, count, 6), values)

    def corners_of(corners, count, a):
        return stencils.gather_listed(Listed(corners, count, 6), (a,))

    count = jnp.asarray(counts)
    found = jax.vmap(sums)(corners, count, values)[0]
    _, pull = jax.vjp(lambda a: jax.vmap(corners_of)(corners, count, a), a)
    (pulled,) = pull(values)
    for scene, number in enumerate(counts):
        expected = np.zeros(6)
        for element in range(min(number, 3)):
            np.add.at(expected, STENCIL.indices[element], [1.0, 2.0, 3.0])
        np.testing.assert_array_equal(found[scene], expected)
        np.testing.assert_array_equal(pulled[scene], expected)


@pytest.mark.parametrize("odd", [-1, 3])
def test_a_vertex_that_is_not_there_is_refused(odd):
    with pytest.raises(ValueError, match=f"an element has vertex {odd}, but there are 3: they count from 0"):
        Stencil([[0, 1], [1, odd]], num_vertices=3)
