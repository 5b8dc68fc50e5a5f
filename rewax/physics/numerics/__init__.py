"""Mathematics that all solvers share."""

from rewax.physics.numerics.elastic_constants import LameParameters, lame_parameters
from rewax.physics.numerics.linalg3 import eigh, polar_components, spectral, svd
from rewax.physics.numerics.pose import Pose, body_pose, static_poses
from rewax.physics.numerics.rotations import quaternion_product, quaternion_to_matrix, rotation_vector, turn_quaternion
from rewax.physics.numerics.substeps import both_ends, scan_substeps

__all__ = [
    "LameParameters", "Pose", "body_pose", "both_ends", "eigh", "lame_parameters", "polar_components",
    "quaternion_product", "quaternion_to_matrix", "rotation_vector", "scan_substeps", "spectral", "static_poses", "svd",
    "turn_quaternion",
]  # fmt: skip
