"""Volumes and bounding boxes: against random points, exact cases, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_shapes import Torus
from solids import FURTHER, SHAPES, distance

from rewax import struct
from rewax.physics import shapes as sdf
from rewax.physics.shapes.sampling import volume
from rewax.physics.shapes.volumes import bounding_box


@pytest.mark.parametrize("name", SHAPES | FURTHER)
def test_volume_and_box_are_those_of_random_points(x64, name):
    """The share of points of the bounding box that lie in the shape, within five standard errors; none beside it."""
    shape = (SHAPES | FURTHER)[name]
    lower, upper = bounding_box(shape)
    points = np.random.default_rng(0).uniform(1.2 * lower, 1.2 * upper, (20_000, 3))
    inside = distance(shape, points) < 0
    assert np.all((points[inside] >= lower) & (points[inside] <= upper))
    whole = np.prod(1.2 * (upper - lower))
    share = float(volume(shape)) / whole
    np.testing.assert_allclose(inside.mean(), share, atol=5 * np.sqrt(share * (1 - share) / len(points)))


def test_volume_of_a_box_whose_faces_hold_nodes_is_exact():
    """Values of zero count neither as inside nor as outside."""
    nodes = jnp.asarray(np.indices((6, 5, 5)).transpose(1, 2, 3, 0) - 2.0)
    values = sdf.signed_distance(sdf.Box(half_size=np.array([2.0, 1.0, 1.0])), nodes - jnp.array([1.0, 0.0, 0.0]))[0]
    assert np.sum(np.asarray(values) == 0) > 20
    baked = sdf.SampledDistance(values=values, origin=jnp.full(3, -2.0), spacing=0.5)
    np.testing.assert_allclose(volume(baked), 16.0 * 0.5**3, rtol=1e-6)


def test_volume_is_differentiable(x64):
    """By the size of a box and by the values of a baked ball."""
    box = jax.grad(lambda h: volume(sdf.Box(half_size=h)))(jnp.array([0.2, 0.3, 0.5]))
    np.testing.assert_allclose(box, 8 * np.array([0.15, 0.1, 0.06]), rtol=1e-12)
    shrunk = jax.grad(lambda d: volume(SHAPES["baked"].replace(values=SHAPES["baked"].values + d)))(0.0)
    np.testing.assert_allclose(shrunk, -4 * np.pi * 0.41**2, rtol=0.02)


@pytest.mark.parametrize("name", [name for name in SHAPES | FURTHER if name != "baked"])
def test_bounding_radius_holds_the_shape_tightly(name):
    shape = (SHAPES | FURTHER)[name]
    farthest = np.linalg.norm(sdf.fill(shape, 0.02), axis=1).max()
    assert farthest <= float(shape.bounding_radius()) < farthest + 0.04


def test_shapes_without_bounds_reach_to_infinity():
    assert sdf.Plane().bounding_radius() == SHAPES["baked"].bounding_radius() == np.inf


@pytest.mark.parametrize("corner", [-1.0, 0.0, np.nan, np.inf])
def test_a_box_without_an_inside_or_an_end_is_refused(corner):
    corners = -np.full(3, corner), np.array([1.0, 1.0, corner])
    shape = struct.dataclass(type("Mine", (Torus,), {"bounding_box": lambda self: corners}))(ring=0.3, tube=0.1)
    for fill in (bounding_box, lambda shape: sdf.fill(shape, 0.1)):
        with pytest.raises(
            ValueError, match=r"^the bounding box of Mine reaches from \(.*\) to \(1, 1, .*\): its upper c"
        ):
            fill(shape)
