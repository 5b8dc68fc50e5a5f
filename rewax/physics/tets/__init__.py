"""Deformable bodies of linear tetrahedra: the finite element method (FEM) with lumped masses."""

from rewax.physics.numerics.pose import static_poses
from rewax.physics.tets import tetmesh
from rewax.physics.tets.invariants import (
    angular_momentum,
    elastic_energy,
    gravitational_energy,
    kinetic_energy,
    momentum,
)
from rewax.physics.tets.law import DampingLaw, small_strain_moduli, stable_parameters
from rewax.physics.tets.scene import TetScene, TetState, initial_state, largest_stable_dt, make_scene
from rewax.physics.tets.stepping import check_status, contact_force, deformation_gradient, internal_force, step, substep
from rewax.physics.tets.tetmesh import TetMesh, boundary_faces, check_tetmesh, load_tetmesh, soft_jumper_table
from rewax.physics.tets.touch import step_with_touch

__all__ = [
    "DampingLaw", "TetMesh", "TetScene", "TetState", "angular_momentum", "boundary_faces", "check_status",
    "check_tetmesh", "contact_force", "deformation_gradient", "elastic_energy", "gravitational_energy",
    "initial_state", "internal_force", "kinetic_energy", "largest_stable_dt", "load_tetmesh", "make_scene",
    "momentum", "small_strain_moduli", "soft_jumper_table", "stable_parameters", "static_poses", "step",
    "step_with_touch", "substep", "tetmesh",
]  # fmt: skip
