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
