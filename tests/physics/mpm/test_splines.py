"""Quadratic B-splines: partition of unity, moments, derivatives, and stencils that never leave the grid."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.mpm.splines import quadratic_bspline

SPACING, ORIGIN, NODES = 0.1, -0.3, 9
INSIDE = hs.lists(hs.floats(ORIGIN + 0.5 * SPACING, ORIGIN + (NODES - 1.5) * SPACING), min_size=8, max_size=8)


def stencil(x):
    return quadratic_bspline(x, origin=ORIGIN, spacing=SPACING, num_nodes=NODES)


def bspline(u):
    """The quadratic B-spline as a function of the distance in cells, written as in textbooks."""
    u = np.abs(u)
    return np.where(u < 0.5, 0.75 - u**2, np.where(u < 1.5, 0.5 * (1.5 - u) ** 2, 0.0))


@given(x=INSIDE)
def test_weights_are_the_spline_at_the_nodes(x64, x):
    x = np.array(x)
    s = stencil(jnp.asarray(x))
    for k in range(3):
        node = ORIGIN + SPACING * (np.asarray(s.base) + k)
        np.testing.assert_allclose(s.weights[k], bspline((x - node) / SPACING), atol=1e-12)
        np.testing.assert_allclose(s.offsets[k], node - x, atol=1e-12)


@given(x=INSIDE)
def test_moments(x64, x):
    """Sum w = 1, sum w d = 0, sum w d^2 = dx^2 / 4: the D of APIC; the slopes' moments are those sums' derivatives."""
    s = stencil(jnp.array(x))
    w, d, slope = (np.stack(a) for a in (s.weights, s.offsets, s.slopes))
    np.testing.assert_allclose(w.sum(0), 1.0, rtol=1e-13)
    np.testing.assert_allclose((w * d).sum(0), 0.0, atol=1e-14)
    np.testing.assert_allclose((w * d * d).sum(0), SPACING**2 / 4, rtol=1e-11)
    np.testing.assert_allclose(slope.sum(0), 0.0, atol=1e-11)
    np.testing.assert_allclose((slope * d).sum(0), 1.0, rtol=1e-11)


def test_slopes_are_derivatives_of_the_weights(x64):
    x = jnp.linspace(ORIGIN + 0.06, ORIGIN + 0.74, 8)
    s = stencil(x)
    for k in range(3):
        _, tangent = jax.jvp(lambda x, k=k: stencil(x).weights[k], (x,), (jnp.ones_like(x),))
        np.testing.assert_allclose(s.slopes[k], tangent, atol=1e-11)


def test_stencils_of_particles_outside_stay_on_the_grid():
    s = stencil(jnp.array([-1e9, -1.0, ORIGIN, 0.55, 5.0, 1e9, jnp.inf, jnp.nan]))
    assert np.all(s.base >= 0) and np.all(s.base <= NODES - 3)


def test_particles_midway_between_nodes_have_one_stencil():
    """Their lowest node hangs on the rounding of a position that the program computes: all users must see the same.

    Linear fields are interpolated exactly. With the weights of one stencil on the nodes of the next one, the result would be
    off by a whole cell.
    """
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.uniform(low, high, 4096), jnp.float32) for low, high in ((0.2, 0.8), (-1.0, 1.0)))
    midway = 0.1 * (rng.integers(2, 10, 4096) + 0.5)
    c = jnp.asarray(midway - np.float64(a) * np.float64(b), jnp.float32)
    nodes = jnp.asarray(0.1 * np.arange(16), jnp.float32)

    @jax.jit
    def interpolate(a, b, c):
        x = a * b + c
        s = quadratic_bspline(x, origin=0.0, spacing=0.1, num_nodes=16)
        total = jnp.zeros(16, jnp.float32)
        for k in range(3):
            total = total.at[s.base + k].add(s.weights[k])
        values = sum(s.weights[k] * nodes[s.base + k] for k in range(3))
        return x, values, nodes[s.base] - s.offsets[0], jnp.vdot(total, nodes)

    x, values, from_offset, moment = interpolate(a, b, c)
    np.testing.assert_allclose(values, midway, atol=1e-6)
    np.testing.assert_allclose(from_offset, x, atol=1e-6)
    np.testing.assert_allclose(moment, midway.sum(), rtol=1e-5)
