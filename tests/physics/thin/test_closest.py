"""Closest points against a search over many points."""

import numpy as np

from rewax.physics.thin import closest

RNG = np.random.default_rng(0)


def difference(weights, x):
    return np.linalg.norm(np.asarray(closest.weighted(weights, x)))


def test_closest_points_are_closer_than_any_of_a_fine_grid(x64):
    u, v = (k.reshape(-1) for k in np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 201)))
    inside = u + v <= 1
    for _ in range(20):
        points = RNG.standard_normal((4, 3))
        x = tuple(tuple(p) for p in points)
        p, a, b, c = points
        tried = p - a - np.outer(u[inside], b - a) - np.outer(v[inside], c - a)
        best = np.linalg.norm(tried, axis=1).min()
        found = difference(closest.vertex_triangle(x), x)
        assert best - 0.03 < found <= best + 1e-12
        tried = p + np.outer(u, a - p) - b - np.outer(v, c - b)
        best = np.linalg.norm(tried, axis=1).min()
        found = difference(closest.segments(x, 1e-6), x)
        assert best - 0.03 < found <= best + 1e-9
