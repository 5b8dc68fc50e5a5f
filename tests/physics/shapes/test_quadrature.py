"""Quadrature against shapes whose volume and moments are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_shapes import Torus
from solids import FURTHER, SHAPES

from rewax import struct
from rewax.physics.shapes import SampledDistance, Shape, Sphere, quadrature

BOUNDED = {name: shape for name, shape in (SHAPES | FURTHER).items() if name != "baked"}


@pytest.mark.parametrize("name", BOUNDED)
def test_volumes_are_those_of_the_formulas(x64, name):
    shape = BOUNDED[name]
    fractions, lower, upper = quadrature.fractions_inside(shape)
    assert fractions.shape == (64, 64, 64) and fractions.min() >= 0.0 and fractions.max() <= 1.0
    np.testing.assert_allclose(quadrature.volume(fractions, lower, upper), shape.volume(), rtol=2e-3)


@pytest.mark.parametrize("name", [name for name in BOUNDED if name != "cone"])
def test_moments_are_those_of_the_formulas(x64, name):
    shape = BOUNDED[name]
    mass, moment = quadrature.inertia(name, 700.0, *quadrature.fractions_inside(shape))
    expected_mass, expected = shape.inertia(700.0)
    np.testing.assert_allclose(mass, expected_mass, rtol=2e-3)
    np.testing.assert_allclose(moment, expected, rtol=2e-3, atol=2e-4 * expected.max())


def test_the_error_is_of_second_order(x64, monkeypatch):
    errors = []
    for num_cells in (16, 32):
        monkeypatch.setattr(quadrature, "NUM_CELLS", num_cells)
        jax.clear_caches()
        volume = quadrature.volume(*quadrature.fractions_inside(Sphere(radius=0.4)))
        errors.append(abs(float(volume) / (4 / 3 * np.pi * 0.4**3) - 1.0))
    jax.clear_caches()
    assert 3.0 < errors[0] / errors[1] < 5.0


@pytest.mark.parametrize("tube", [0.01, 1e-5])
def test_thin_shapes_are_refused(tube):
    """By an estimate: their volumes would be 27 % too small, and zero."""
    thin = Torus(ring=0.5, tube=tube)
    for size in (thin.volume, lambda: thin.inertia(700.0)):
        with pytest.raises(ValueError, match=r"^Torus is too thin .* write its methods volume and inertia$"):
            size()
    assert float(jax.jit(lambda shape: shape.volume())(thin)) < 0.8 * 2 * np.pi**2 * 0.5 * tube**2  # traced


def test_a_solid_beside_the_origin_has_no_moments_about_it():
    with pytest.raises(
        ValueError, match=r"^the centre of mass of the Cone is \(.*, -0\.25, .*\), but must be the origin"
    ):
        FURTHER["cone"].inertia(1.0)


def test_derivatives_of_the_volume_inside_a_program(x64):
    """By both radii, sizes traced, for two shapes at once."""
    tori = Torus(ring=jnp.array([0.3, 0.5]), tube=jnp.array([0.1, 0.2]))
    found = jax.jit(jax.vmap(jax.grad(lambda torus: torus.volume())))(tori)
    np.testing.assert_allclose(found.ring, 2 * np.pi**2 * tori.tube**2, rtol=5e-3)
    np.testing.assert_allclose(found.tube, 4 * np.pi**2 * tori.ring * tori.tube, rtol=5e-3)


@struct.dataclass
class Half(Shape):
    """The lower half of its box: nodes lie on the surface."""

    def distance(self, p):
        zero = jnp.zeros_like(p[1])
        return p[1], (zero, zero + 1.0, zero)

    def bounding_box(self):
        return -jnp.ones(3), jnp.ones(3)


def test_nodes_on_a_surface_count_as_outside():
    fractions, lower, upper = quadrature.fractions_inside(Half())
    np.testing.assert_array_equal(np.unique(fractions[:, :32]), [1.0])
    assert quadrature.volume(fractions, lower, upper) == 4.0


def test_derivative_of_a_volume_whose_surface_passes_through_nodes(x64):
    """The whole slab moves: its volume changes by its area, whatever lies on a node."""
    planes = np.broadcast_to(np.linspace(-1.0, 1.0, 5)[:, None, None], (5, 5, 5))
    slab = SampledDistance(values=jnp.asarray(planes), origin=-jnp.ones(3), spacing=0.5)
    volume = lambda offset: slab.replace(values=slab.values + offset).volume()  # noqa: E731
    for offset in (0.0, 0.01, 0.5):
        value, slope = jax.value_and_grad(volume)(offset)
        np.testing.assert_allclose([value, slope], [4.0 * (1.0 - offset), -4.0], rtol=1e-9)
