"""Points near triangles: the tree finds what comparing all finds, and each point of a surface is counted once."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import thin
from rewax.physics.coupling.triangle_tree import TriangleTree, close_to_triangles, shares
from rewax.physics.numerics import components as cp
from rewax.physics.thin import closest

FIND = jax.jit(close_to_triangles, static_argnums=(0, 4))


def crumpled(n=12, seed=0):
    mesh = thin.sheet(1.0, 1.0, n, n)
    rng = np.random.default_rng(seed)
    return mesh, np.asarray(mesh.vertices) + 0.1 * rng.standard_normal(mesh.vertices.shape)


def brute_force(triangles, points, x, reach):
    corners = [x[triangles[:, k]] for k in range(3)]
    own = tuple(tuple(jnp.asarray(c[..., i]) for i in range(3)) for c in
                np.broadcast_arrays(points[:, None], *(c[None] for c in corners)))  # fmt: skip
    gap = cp.norm(closest.weighted(closest.vertex_triangle(own), own))
    return {tuple(pair) for pair in np.argwhere(np.asarray(gap) < reach).tolist()}


def found(tree, points, x, reach, capacity):
    return FIND(tree, cp.split_vector(jnp.asarray(points)), cp.split_vector(jnp.asarray(x)), reach, capacity)


def test_the_tree_finds_what_comparing_all_pairs_finds(x64):
    mesh, x = crumpled()
    tree = TriangleTree(mesh.triangles, mesh.vertices)
    assert tree.levels > 1
    points = np.random.default_rng(1).uniform(-0.1, 1.1, (150, 3)) * [1.0, 0.3, 1.0]
    expected = brute_force(mesh.triangles, points, x, 0.05)
    pairs = found(tree, points, x, 0.05, 20 * 150)
    valid = np.asarray(pairs.valid)
    got = list(zip(np.asarray(pairs.points)[valid].tolist(), np.asarray(pairs.triangles)[valid].tolist(), strict=True))
    assert len(expected) > 100 and len(got) == len(set(got)) and set(got) == expected and not bool(pairs.full)


def test_a_list_that_is_too_short_says_so(x64):
    mesh, x = crumpled()
    tree = TriangleTree(mesh.triangles, mesh.vertices)
    points = np.random.default_rng(1).uniform(0.0, 1.0, (150, 3)) * [1.0, 0.1, 1.0]
    count = len(brute_force(mesh.triangles, points, x, 0.05))
    assert not bool(found(tree, points, x, 0.05, 4 * count).full)
    assert bool(found(tree, points, x, 0.05, count - 1).full)


def test_a_vmapped_search_is_the_search_of_each(x64):
    mesh, x = crumpled(4)
    tree = TriangleTree(mesh.triangles, mesh.vertices)
    rng = np.random.default_rng(2)
    points = jnp.asarray(rng.uniform(0.0, 1.0, (3, 10, 3)) * [1.0, 0.1, 1.0])
    both = [cp.split_vector(points), cp.split_vector(jnp.asarray(x))]
    many = jax.vmap(lambda p: close_to_triangles(tree, p, both[1], jnp.asarray(0.05), 60))(both[0])
    for k in range(3):
        one = close_to_triangles(tree, tuple(a[k] for a in both[0]), both[1], jnp.asarray(0.05), 60)
        jax.tree.map(lambda a, b, k=k: np.testing.assert_array_equal(a[k], b), many, one)


def test_shares_count_each_edge_and_corner_once():
    """Triangles around a point in the region of an edge or corner count it together exactly once."""
    mesh = thin.sheet(1.0, 1.0, 5, 4)
    triangles, each = np.asarray(mesh.triangles), shares(mesh.triangles)
    edges, corners = {}, {}
    for t, row in zip(triangles.tolist(), each, strict=True):
        for (a, b), share in zip(((0, 1), (0, 2), (1, 2)), row[:3], strict=True):
            edges.setdefault(frozenset((t[a], t[b])), []).append(share)
        for vertex, share in zip(t, row[3:], strict=True):
            corners.setdefault(vertex, []).append(share)
    for counted in edges.values():
        np.testing.assert_allclose(len(counted) + sum(counted), 1.0)
    for vertex, counted in corners.items():
        around = sum(sum(counts) for edge, counts in edges.items() if vertex in edge)
        np.testing.assert_allclose(len(counted) + around + sum(counted), 1.0, atol=1e-12)
