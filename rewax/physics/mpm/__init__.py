"""The moving least squares material point method (MLS-MPM)."""

from rewax.physics.mpm import invariants, laws
from rewax.physics.mpm.active_nodes import count_nodes
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.laws import *  # noqa: F403
from rewax.physics.mpm.materials import Material, sound_speed
from rewax.physics.mpm.memory import predict_peak_bytes
from rewax.physics.mpm.scene import (
    STABLE_COURANT_NUMBER,
    MPMScene,
    MPMState,
    check_placement,
    initial_state,
    largest_stable_dt,
    make_scene,
    particle_mass,
)
from rewax.physics.mpm.stepping import check_status, deform, nodes_of_step, step, substep
from rewax.physics.mpm.touch import step_with_touch
from rewax.physics.mpm.walls import Wall, WallKind, Walls
from rewax.physics.numerics.pose import static_poses

__all__ = [
    "STABLE_COURANT_NUMBER", "Grid", "MPMScene", "MPMState", "Material", "Wall", "WallKind", "Walls",
    "check_placement", "check_status", "count_nodes", "deform", "initial_state", "invariants", "largest_stable_dt",
    "laws", "make_scene", "nodes_of_step", "particle_mass", "predict_peak_bytes", "sound_speed", "static_poses",
    "step", "step_with_touch", "substep",
]  # fmt: skip
__all__ += laws.__all__
