"""Terrain: planes, which bilinear heights reproduce, and beyond the grid."""

import jax
import jax.numpy as jnp
import numpy as np
from shape_cases import NUM, TERRAIN, evaluate


def test_height_of_a_slope_is_the_distance_to_its_plane(x64):
    """Within the field exact, beyond it level; halfway along an edge of a cell the mean of its ends."""
    x, z = np.indices((5, 4)) * 0.4 + np.array([-0.8, -0.5])[:, None, None]
    slope = TERRAIN.replace(heights=0.1 + 0.3 * x - 0.4 * z)
    p = np.random.default_rng(9).uniform([-0.8, -1, -0.5], [0.8, 1, 0.7], (NUM, 3))
    distance, normal = evaluate(slope, p)
    np.testing.assert_allclose(distance, (p @ [-0.3, 1.0, 0.4] - 0.1) / np.sqrt(1.25), atol=1e-13)
    np.testing.assert_allclose(
        normal, np.broadcast_to(np.array([-0.3, 1.0, 0.4]) / np.sqrt(1.25), (NUM, 3)), atol=1e-12
    )
    p[:] = [9.0, 0.0, 9.0]
    p[0] = [-0.6, 0.0, -0.5]
    distance, normal = evaluate(TERRAIN, p)
    np.testing.assert_allclose(distance[0] / normal[0, 1], -TERRAIN.heights[:2, 0].mean(), rtol=1e-12)
    np.testing.assert_allclose(distance[1:], -TERRAIN.heights[-1, -1], rtol=1e-12)
    np.testing.assert_allclose(normal[1:], np.broadcast_to([0.0, 1.0, 0.0], (NUM - 1, 3)), atol=1e-14)


def test_slopes_of_rays_are_those_of_differences(x64):
    """By where rays begin and go, heights, origin and spacing; reverse equals forward."""
    rng = np.random.default_rng(4)
    start = jnp.asarray(rng.uniform([-0.6, 0.8, -0.4], [0.6, 1.0, 0.5], (NUM, 3)))
    way = jnp.asarray(rng.uniform([-0.4, -1.0, -0.4], [0.4, -0.8, 0.4], (NUM, 3)))
    point = (
        start,
        way,
        TERRAIN.replace(**{k: jnp.asarray(getattr(TERRAIN, k)) for k in ("heights", "origin", "spacing")}),
    )
    weights = jnp.asarray(rng.standard_normal(NUM))

    @jax.jit
    def total(point):
        start, way, terrain = point
        t = terrain.cast(tuple(start.T), tuple(way.T))
        return jnp.sum(jnp.where(jnp.isfinite(t), weights * t, 0.0)), jnp.isfinite(t).sum()

    assert total(point)[1] > NUM / 2
    slope = jax.grad(lambda p: total(p)[0])(point)
    for leaf in jax.tree.leaves(slope):
        assert np.abs(leaf).max() > 1e-3
    along = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(np.shape(a))), point)
    moved = [total(jax.tree.map(lambda a, d, s=s: a + s * 1e-7 * d, point, along))[0] for s in (1, -1)]
    reverse = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(along), strict=True))
    np.testing.assert_allclose(reverse, (moved[0] - moved[1]) / 2e-7, rtol=1e-5)
    np.testing.assert_allclose(jax.jvp(lambda p: total(p)[0], (point,), (along,))[1], reverse, rtol=1e-10)
