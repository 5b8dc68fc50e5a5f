"""The kernels for CPUs: indices of nodes, sums by visiting every node, and sizes that do not fit."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.mpm import transfer_xla_cpu
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.transfer_xla_cpu import Layout

GRID = Grid(shape=(6, 7, 5), spacing=0.1)
LAYOUT = Layout(GRID, None)
BATCH = (2, 9)
X = np.random.default_rng(0).uniform(0.1, 0.3, (3, *BATCH))


def nodes_of(copy, particle):
    """Flat index among both environments, weight and offset of the 27 nodes around a particle."""
    x = X[:, copy, particle]
    base = np.floor(x / GRID.spacing - 0.5).astype(int)
    for step in itertools.product(range(3), repeat=3):
        node = base + step
        d = node * GRID.spacing - x
        u = np.abs(d) / GRID.spacing
        w = np.where(u < 0.5, 0.75 - u**2, 0.5 * (1.5 - u) ** 2).prod()
        yield copy * GRID.num_nodes + np.ravel_multi_index(node, GRID.shape), w, d


def test_rows_are_the_lowest_of_three_nodes_along_z():
    st, _ = transfer_xla_cpu.stencils(LAYOUT, tuple(jnp.asarray(a) for a in X))
    rows = np.asarray(st.rows).reshape(9, *BATCH)
    for copy, particle in np.ndindex(*BATCH):
        expected = [place for place, _, _ in nodes_of(copy, particle)][::3]
        assert rows[:, copy, particle].tolist() == expected


def test_sums_by_visiting_every_node(x64):
    draw = np.random.default_rng(1)
    mass, p, A = draw.random(BATCH), draw.standard_normal((3, *BATCH)), draw.standard_normal((3, 3, *BATCH))
    linear = [jnp.asarray(a) for a in (mass, *p, *A.reshape(9, *BATCH))]
    found = transfer_xla_cpu.scatter(LAYOUT, tuple(jnp.asarray(a) for a in X), tuple(linear))
    sums = np.zeros((4, 2 * GRID.num_nodes))
    g = draw.standard_normal((3, 2 * GRID.num_nodes))
    values, moments = np.zeros((3, *BATCH)), np.zeros((3, 3, *BATCH))
    for at in np.ndindex(*BATCH):
        for place, w, d in nodes_of(*at):
            sent = p[(slice(None), *at)] + A[(slice(None), slice(None), *at)] @ d
            sums[:, place] += w * np.concatenate([[mass[at]], sent])
            values[(slice(None), *at)] += w * g[:, place]
            moments[(slice(None), slice(None), *at)] += w * np.outer(g[:, place], d)
    np.testing.assert_allclose(np.stack(found).reshape(4, -1), sums, atol=1e-12)
    fields = tuple(jnp.asarray(a.reshape(2, -1)) for a in g)
    gathered = np.stack(transfer_xla_cpu.gather_values(LAYOUT, tuple(jnp.asarray(a) for a in X), fields))
    np.testing.assert_allclose(gathered, np.concatenate([values, moments.reshape(9, *BATCH)]), atol=1e-12)


def test_too_many_copies_are_refused():
    layout = Layout(Grid(shape=(800, 800, 800), spacing=0.1), None)
    with pytest.raises(ValueError, match=r"environments of 512000000 nodes are stepped at once.*step fewer at once"):
        transfer_xla_cpu.env_of_particles(layout, (2, 4))
