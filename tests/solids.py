"""Bounded shapes of each kind, for tests of volumes and of fillings."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import shapes as sdf

NODES = np.indices((25, 25, 25)) * 0.05 - 0.6
with jax.enable_x64(True):
    SHAPES = {
        "box": sdf.Box(half_size=np.array([0.2, 0.3, 0.5])),
        "sphere": sdf.Sphere(radius=0.4),
        "cylinder": sdf.Cylinder(radius=0.3, half_length=0.5),
        "baked": sdf.SampledDistance(
            values=np.linalg.norm(NODES, axis=0) - 0.41, origin=np.full(3, -0.6), spacing=0.05
        ),
    }
    FURTHER = {
        "capsule": sdf.Capsule(radius=0.3, half_length=0.2),
        "cone": sdf.Cone(radius=0.3, half_length=0.5),
        "ellipsoid": sdf.Ellipsoid(semi_axes=np.array([0.2, 0.3, 0.5])),
    }


def distance(shape, points):
    return np.asarray(sdf.signed_distance(shape, jnp.asarray(points))[0])
