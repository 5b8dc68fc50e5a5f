"""Solids given by numbers on a grid: functions that interpolation reproduces, and beyond the grid."""

import jax
import jax.numpy as jnp
import numpy as np
from shape_cases import NUM, SAMPLED, evaluate, points


def test_samples_of_a_trilinear_function_give_it_back(x64):
    """Value and direction of the gradient, within the grid's box."""
    k = np.random.default_rng(5).normal(size=(2, 2, 2))

    def trilinear(x, y, z):
        return sum(k[a, b, c] * x**a * y**b * z**c for a in (0, 1) for b in (0, 1) for c in (0, 1))

    nodes = np.indices((4, 3, 5)) * 0.45 + np.array([-0.6, -0.5, -0.7])[:, None, None, None]
    shape = SAMPLED.replace(values=trilinear(*nodes))
    p = np.random.default_rng(6).uniform([-0.6, -0.5, -0.7], [0.75, 0.4, 1.1], (NUM, 3))
    distance, normal = evaluate(shape, p)
    gradient = jax.vmap(jax.grad(lambda q: trilinear(*q)))(p)
    np.testing.assert_allclose(distance, trilinear(*p.T), rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(normal, gradient / jnp.linalg.norm(gradient, axis=1, keepdims=True), atol=1e-11)


def test_beyond_its_box_a_sampled_distance_grows_with_the_distance_to_the_box(x64):
    p = points(8) * 2.0
    at = np.clip(p, [-0.6, -0.5, -0.7], [0.75, 0.4, 1.1])
    away = np.linalg.norm(p - at, axis=1)
    assert np.sum(away > 0) > NUM // 2
    np.testing.assert_allclose(evaluate(SAMPLED, p)[0], evaluate(SAMPLED, at)[0] + away, rtol=1e-11, atol=1e-13)
