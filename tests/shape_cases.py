"""One shape of each kind, points around it, and its distance with derivatives, compiled once."""

from collections.abc import Callable

import jax
import numpy as np

from rewax.physics import shapes as sdf

NUM = 64
R, H, HALF = 0.4, 0.7, np.array([0.3, 0.5, 0.8])
RNG = np.random.default_rng(7)
with jax.enable_x64(True):  # numbers become arrays when a shape is built, of the type that is then the default
    SHAPES = {
        "sphere": sdf.Sphere(radius=R),
        "capsule": sdf.Capsule(radius=R, half_length=H),
        "box": sdf.Box(half_size=HALF),
        "cylinder": sdf.Cylinder(radius=R, half_length=H),
        "cone": sdf.Cone(radius=R, half_length=H),
        "plane": sdf.Plane(),
    }
    SAMPLED = sdf.SampledDistance(values=RNG.normal(size=(4, 3, 5)), origin=np.array([-0.6, -0.5, -0.7]), spacing=0.45)
    TERRAIN = sdf.HeightField(heights=RNG.normal(size=(5, 4)), origin=np.array([-0.8, -0.5]), spacing=0.4)
    ELLIPSOID = sdf.Ellipsoid(semi_axes=HALF)
ALL = SHAPES | {"ellipsoid": ELLIPSOID, "sampled": SAMPLED, "terrain": TERRAIN}
evaluate = jax.jit(sdf.signed_distance)


def points(seed: int) -> np.ndarray:
    p = np.random.default_rng(seed).uniform(-1.2, 1.2, (NUM, 3))
    p[: NUM // 4] *= 0.2
    return p


def assert_nearest(shape, seed: int, project: Callable, depth: Callable) -> None:
    """Distances and normals of a shape are those that its projection and depth inside say."""
    p = points(seed)
    distance, normal = (np.asarray(a) for a in evaluate(shape, p))
    outside = np.linalg.norm(p - project(p), axis=1)
    is_out = outside > 0
    assert is_out.any() and not is_out.all()
    np.testing.assert_allclose(distance[is_out], outside[is_out], rtol=1e-12)
    np.testing.assert_allclose(distance[~is_out], -depth(p[~is_out]), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose((p - distance[:, None] * normal)[is_out], project(p)[is_out], atol=1e-12)


@jax.jit
def derivatives(args, tangents, cotangents):
    """Of distance and normal, by everything: forward, reverse."""
    return jax.jvp(sdf.signed_distance, args, tangents)[1], jax.vjp(sdf.signed_distance, *args)[1](cotangents)
