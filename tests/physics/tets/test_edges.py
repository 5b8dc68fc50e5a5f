"""From vertices to edges and back: one tetrahedron by hand, and two maps that are each other's transpose."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.numerics import components as cp
from rewax.physics.tets import tetmesh
from rewax.physics.tets.edges import TetTopology, edges, gather_forces

BOX = tetmesh.box((0.4, 0.2, 0.2), (2, 1, 1), tets_per_cell=5)
TOPOLOGY = TetTopology(BOX.tets, len(BOX.vertices))
CORNER = TetTopology(np.array([[2, 0, 1, 3]]), 5)
"""One tetrahedron, whose vertices are not in order, and a vertex that belongs to none."""


def test_edges_of_one_tetrahedron():
    """Column k is vertex k + 1 minus vertex 0, in the tetrahedron's order of vertices."""
    x = jnp.asarray(np.random.default_rng(0).standard_normal((5, 3)))
    columns = np.stack([x[0] - x[2], x[1] - x[2], x[3] - x[2]], axis=1)
    np.testing.assert_array_equal(cp.join_matrix(edges(CORNER, cp.split_vector(x)))[0], columns)


def test_forces_of_one_tetrahedron():
    """Column k goes to vertex k + 1, minus their sum to vertex 0, and nothing to the lonely vertex."""
    columns = jnp.asarray([[[1.0, 10.0, 100.0], [2.0, 20.0, 200.0], [3.0, 30.0, 300.0]]])
    force = cp.join_vector(gather_forces(CORNER, cp.split_matrix(columns)))
    expected = [[1.0, 2.0, 3.0], [10.0, 20.0, 30.0], [-111.0, -222.0, -333.0], [100.0, 200.0, 300.0], [0.0, 0.0, 0.0]]
    np.testing.assert_array_equal(force, expected)


@given(seed=hs.integers(0, 10_000))
def test_both_are_the_loops_over_tetrahedra_and_each_others_transpose(x64, seed):
    """<columns, edges(x)> = <gather(columns), x>; forces sum to zero; a common shift has no edges."""
    rng = np.random.default_rng(seed)
    x, columns = rng.standard_normal((12, 3)), rng.standard_normal((10, 3, 3))
    force = np.zeros((12, 3))
    for tet, block in zip(BOX.tets, columns, strict=True):
        for k in (1, 2, 3):
            force[tet[k]] += block[:, k - 1]
            force[tet[0]] -= block[:, k - 1]
    got = np.asarray(cp.join_vector(GATHER(cp.split_matrix(jnp.asarray(columns)))))
    np.testing.assert_allclose(got, force, atol=1e-13)
    np.testing.assert_allclose(got.sum(axis=0), 0.0, atol=1e-13)
    along = np.asarray(cp.join_matrix(EDGES(cp.split_vector(jnp.asarray(x)))))
    np.testing.assert_array_equal(along, np.swapaxes(x[BOX.tets][:, 1:] - x[BOX.tets][:, :1], 1, 2))
    np.testing.assert_allclose(np.vdot(columns, along), np.vdot(got, x), rtol=1e-11, atol=1e-11)


EDGES = jax.jit(lambda x: edges(TOPOLOGY, x))
GATHER = jax.jit(lambda columns: gather_forces(TOPOLOGY, columns))


def test_derivatives_are_the_maps_themselves(x64, random_like):
    """Forward the map of the direction, reverse the other map of the cotangent; under vmap too."""
    x = cp.split_vector(jnp.asarray(BOX.vertices))
    columns = cp.split_matrix(jnp.ones((10, 3, 3)))
    for map_, other, argument in ((EDGES, GATHER, x), (GATHER, EDGES, columns)):
        direction = random_like(0, argument)
        value, tangent = jax.jvp(map_, (argument,), (direction,))
        jax.tree.map(np.testing.assert_array_equal, tangent, map_(direction))
        cotangent = random_like(1, value)
        (back,) = jax.vjp(map_, argument)[1](cotangent)
        jax.tree.map(np.testing.assert_array_equal, back, other(cotangent))
        several = random_like(2, jax.tree.map(lambda a: jnp.zeros((3, *a.shape)), argument))
        together = jax.vmap(map_)(several)
        for i in range(3):
            alone = map_(jax.tree.map(lambda a, i=i: a[i], several))
            jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-15), together, alone)


def test_equal_topologies_are_one_program():
    """Read again they are equal and hash alike; other tetrahedra or another number of vertices are others."""
    again = TetTopology(BOX.tets.copy(), 12)
    assert again == TOPOLOGY and hash(again) == hash(TOPOLOGY)
    assert TetTopology(BOX.tets, 13) != TOPOLOGY
    assert TetTopology(BOX.tets[::-1], 12) != TOPOLOGY
    assert TOPOLOGY != "a topology"
    assert repr(TOPOLOGY) == "TetTopology(10 tets, 12 vertices)"
    assert not TOPOLOGY.tets.flags.writeable


def test_the_given_array_may_change_afterwards():
    given_tets = BOX.tets.copy()
    topology = TetTopology(given_tets, 12)
    given_tets[:] = 0
    assert topology == TOPOLOGY
