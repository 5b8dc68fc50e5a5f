"""Shapes given by signed distance functions (SDF): primitives, meshes, sampled fields, your own; volumes and points."""

from rewax.physics.shapes.base import Shape, signed_distance
from rewax.physics.shapes.ellipsoid import Ellipsoid
from rewax.physics.shapes.flat import Box, Plane
from rewax.physics.shapes.height_field import HeightField
from rewax.physics.shapes.mesh_sdf import bake_mesh, check_mesh
from rewax.physics.shapes.revolved import Cone, Cylinder
from rewax.physics.shapes.round import Capsule, Sphere
from rewax.physics.shapes.sampled import SampledDistance
from rewax.physics.shapes.sampling import fill, fill_box, sample, sample_box, sample_poisson_disk
from rewax.physics.shapes.volumes import bounding_box, volume

__all__ = [
    "Box", "Capsule", "Cone", "Cylinder", "Ellipsoid", "HeightField", "Plane", "SampledDistance", "Shape",
    "Sphere", "bake_mesh", "bounding_box", "check_mesh", "fill", "fill_box", "sample", "sample_box",
    "sample_poisson_disk", "signed_distance", "volume",
]  # fmt: skip
