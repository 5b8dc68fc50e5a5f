"""Colliders are drawn where they act."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_shapes import Torus

from rewax import struct
from rewax.physics.contact import Collider, drawings
from rewax.physics.numerics import Pose
from rewax.physics.shapes import (
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Plane,
    SampledDistance,
    Sphere,
    distance_surface,
    signed_distance,
)
from rewax.physics.shapes import sampled_surface as surfaces
from rewax.viz.shapes import check_drawing, placed, support

QUARTER = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Turns x to y."""
BODIES = Pose(jnp.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]), jnp.stack([jnp.eye(3), QUARTER]))
SHAPES = (
    Sphere(radius=jnp.asarray(0.2)),
    Capsule(radius=jnp.asarray(0.1), half_length=jnp.asarray(0.3)),
    Cylinder(radius=jnp.asarray(0.1), half_length=jnp.asarray(0.3)),
    Cone(radius=jnp.asarray(0.1), half_length=jnp.asarray(0.3)),
    Box(half_size=jnp.array([0.1, 0.2, 0.3])),
    Ellipsoid(semi_axes=jnp.array([0.1, 0.2, 0.3])),
)


def baked(shape, spacing=0.02, half=0.4):
    """Another shape as numbers on a grid."""
    axis = np.arange(-half, half + 1e-9, spacing, dtype=np.float32)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = signed_distance(shape, jnp.asarray(nodes.reshape(-1, 3)))[0].reshape(nodes.shape[:3])
    return SampledDistance(values=values, origin=jnp.full(3, -half), spacing=jnp.asarray(spacing))


@pytest.fixture
def skimage():
    forget()
    yield pytest.importorskip("skimage")
    forget()


def forget():
    for memory in (surfaces._surface, surfaces._marching_cubes, distance_surface._surface):
        memory.cache_clear()


def test_outermost_points_of_drawings_lie_on_the_colliders_surfaces():
    colliders = [Collider(shape=s, offset=jnp.array([0.5, 0.0, 0.0]), friction=0.0, body=1) for s in SHAPES]
    found = drawings(colliders, BODIES)
    assert [drawing["kind"] for drawing in found] == [
        "sphere", "capsule", "cylinder", "cone", "box", "ellipsoid",
    ]  # fmt: skip
    for drawing, shape in zip(found, SHAPES, strict=True):
        check_drawing(drawing)
        np.testing.assert_allclose(drawing["center"], [1.0, 2.5, 3.0], atol=1e-6)
        points = np.random.default_rng(1).uniform(-1.0, 1.0, (200_000, 3)) * [0.2, 0.4, 0.3]
        inside = points[np.asarray(signed_distance(shape, jnp.asarray(points, jnp.float32))[0]) <= 0]
        for direction in np.random.default_rng(0).normal(size=(8, 3)):
            direction /= np.linalg.norm(direction)
            reach = float(support(drawing, direction) @ direction)
            local = np.asarray(QUARTER).T @ direction
            most = float(np.max(inside @ local)) + float(np.array([1.0, 2.5, 3.0]) @ direction)
            assert most - 1e-5 <= reach < most + 0.06


def test_a_sampled_distance_is_drawn_like_the_shape_it_was_sampled_from(skimage):
    collider = Collider(shape=SHAPES[0], offset=jnp.array([0.5, 0.0, 0.0]), friction=0.0, body=1)
    for shape in (SHAPES[-1], SHAPES[3]):
        (found,) = drawings([collider.replace(shape=baked(shape))], BODIES)
        (expected,) = drawings([collider.replace(shape=shape)], BODIES)
        check_drawing(found)
        assert found["kind"] == "mesh"
        directions = np.random.default_rng(0).normal(size=(50, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        reach, exact = (np.sum(support(drawing, directions) * directions, axis=1) for drawing in (found, expected))
        np.testing.assert_allclose(reach, exact, atol=0.02)  # the tip of the cone is rounded off


def test_a_shape_without_a_drawing_of_its_own_is_drawn_where_its_distance_is_zero(skimage):
    collider = Collider(shape=Torus(ring=0.3, tube=0.1), offset=jnp.array([0.5, 0.0, 0.0]), friction=0.0, body=1)
    (found,) = drawings([collider], BODIES)
    check_drawing(found)
    local = (placed(found, found["vertices"]) - np.array([1.0, 2.5, 3.0])) @ np.asarray(QUARTER)
    assert found["kind"] == "mesh" and np.abs(signed_distance(collider.shape, jnp.asarray(local))[0]).max() < 2e-3
    np.testing.assert_allclose(np.ptp(local, axis=0), [0.8, 0.2, 0.8], atol=5e-3)


def test_a_drawing_may_lie_beside_the_origin_of_its_shape():
    class Dumbbell(Sphere):
        def draw(self):
            end = {"kind": "cylinder", "radius": 0.1, "half_length": 0.02, "direction": np.array([1.0, 0.0, 0.0])}
            return [{**end, "center": np.array([x, 0.0, 0.0])} for x in (-0.2, 0.2)]

    kind = struct.dataclass(Dumbbell)
    left, right = drawings([Collider(shape=kind(radius=0.2), friction=0.0, body=1)], BODIES)
    np.testing.assert_allclose([left["center"], right["center"]], [[1.0, 1.8, 3.0], [1.0, 2.2, 3.0]], atol=1e-6)
    np.testing.assert_allclose(left["direction"], [0.0, 1.0, 0.0], atol=1e-6)


def test_triangles_of_a_moving_collider_are_no_part_of_the_program(skimage):
    collider = Collider(shape=baked(SHAPES[0]), friction=0.0, body=1)
    kept = []

    def place(position):
        (found,) = drawings([collider], Pose(BODIES.position.at[1].set(position), BODIES.rotation))
        kept.append(found)
        return found["center"]

    np.testing.assert_allclose(jax.jit(place)(jnp.ones(3)), 1.0)
    place(jnp.zeros(3))
    for key in ("vertices", "triangles"):
        assert isinstance(kept[0][key], np.ndarray) and kept[0][key] is kept[1][key]


def test_shapes_without_a_drawing_are_left_out(skimage, monkeypatch):
    sampled = Collider(shape=baked(SHAPES[0]), friction=0.0)
    assert drawings([Collider(shape=Plane(), friction=0.0)], BODIES) == []
    counts = []
    jax.eval_shape(lambda collider: counts.append(len(drawings([collider], BODIES))), sampled)  # its numbers are traced
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.warns(
        UserWarning, match=r"left out of pictures: they need scikit-image, pip install 'rewax\[surfaces\]'"
    ):
        assert counts == [0] and drawings([sampled], BODIES) == []
