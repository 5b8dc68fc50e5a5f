"""Mathematics and compilation tools that all solvers share."""

from rewax.physics.numerics.elastic_constants import LameParameters, lame_parameters
from rewax.physics.numerics.linalg3 import eigh, polar_components, spectral, svd
from rewax.physics.numerics.materialize import compute_once, materialize
from rewax.physics.numerics.pose import Pose, body_pose, static_poses
from rewax.physics.numerics.recompute import both_ends, recomputed, scan_substeps
from rewax.physics.numerics.rotations import quaternion_product, quaternion_to_matrix, rotation_vector, turn_quaternion

__all__ = [
    "LameParameters", "Pose", "body_pose", "both_ends", "compute_once", "eigh", "lame_parameters", "materialize",
    "polar_components", "quaternion_product", "quaternion_to_matrix", "recomputed", "rotation_vector", "scan_substeps",
    "spectral", "static_poses", "svd", "turn_quaternion",
]  # fmt: skip
