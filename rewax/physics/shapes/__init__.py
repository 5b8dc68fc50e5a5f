"""Shapes by their signed distance: primitives, meshes, sampled fields; volumes and points of them."""

from rewax.physics.shapes.mesh_sdf import bake_mesh, check_mesh
from rewax.physics.shapes.primitives import (
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Plane,
    Shape,
    Sphere,
    signed_distance,
)
from rewax.physics.shapes.sampled import HeightField, SampledDistance
from rewax.physics.shapes.sampling import fill, fill_box, sample, sample_box, sample_poisson_disk
from rewax.physics.shapes.volume import bounding_box, volume

__all__ = [
    "Box", "Capsule", "Cone", "Cylinder", "Ellipsoid", "HeightField", "Plane", "SampledDistance", "Shape",
    "Sphere", "bake_mesh", "bounding_box", "check_mesh", "fill", "fill_box", "sample", "sample_box",
    "sample_poisson_disk", "signed_distance", "volume",
]  # fmt: skip
