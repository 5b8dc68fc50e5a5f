"""Colliders are drawn where they act."""

import jax.numpy as jnp
import numpy as np

from rewax.physics.contact import Collider, drawings
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box, Capsule, Cone, Cylinder, Sphere
from rewax.physics.shapes.primitives import signed_distance
from rewax.viz.shapes import check_drawing, support

QUARTER = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Turns x to y."""
BODIES = Pose(jnp.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]), jnp.stack([jnp.eye(3), QUARTER]))
SHAPES = (
    Sphere(radius=jnp.asarray(0.2)),
    Capsule(radius=jnp.asarray(0.1), half_length=jnp.asarray(0.3)),
    Cylinder(radius=jnp.asarray(0.1), half_length=jnp.asarray(0.3)),
    Box(half_size=jnp.array([0.1, 0.2, 0.3])),
)


def test_outermost_points_of_drawings_lie_on_the_colliders_surfaces():
    colliders = [Collider(shape=s, offset=jnp.array([0.5, 0.0, 0.0]), friction=0.0, body=1) for s in SHAPES]
    found = drawings(colliders, BODIES)
    assert [drawing["kind"] for drawing in found] == ["sphere", "capsule", "cylinder", "box"]
    for drawing, shape in zip(found, SHAPES, strict=True):
        check_drawing(drawing)
        np.testing.assert_allclose(drawing["center"], [1.0, 2.5, 3.0], atol=1e-6)
        for direction in np.random.default_rng(0).normal(size=(8, 3)):
            direction /= np.linalg.norm(direction)
            reach = float(support(drawing, direction) @ direction)
            local = np.asarray(QUARTER).T @ direction
            points = np.random.default_rng(1).uniform(-0.6, 0.6, (20_000, 3))
            inside = points[np.asarray(signed_distance(shape, jnp.asarray(points, jnp.float32))[0]) <= 0]
            most = float(np.max(inside @ local)) + float(np.array([1.0, 2.5, 3.0]) @ direction)
            assert most - 1e-5 <= reach < most + 0.06


def test_shapes_without_a_drawing_are_left_out():
    cone = Cone(radius=jnp.asarray(0.1), half_length=jnp.asarray(0.2))
    assert drawings([Collider(shape=cone, friction=0.0)], BODIES) == []
