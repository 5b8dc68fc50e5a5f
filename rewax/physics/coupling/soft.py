"""The solvers of soft bodies that can be coupled, through the interface that ``free`` and ``articulated`` use."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from rewax.physics.coupling import nodes, vertices
from rewax.physics.coupling.exchange import SoftContact
from rewax.physics.mpm.packing import join as join_particles
from rewax.physics.mpm.packing import split as split_particles
from rewax.physics.mpm.scene import MPMScene, MPMState
from rewax.physics.mpm.stepping import nodes_of_step
from rewax.physics.numerics.fields import instance
from rewax.physics.tets.scene import TetScene, TetState
from rewax.physics.tets.stepping import join as join_vertices
from rewax.physics.tets.stepping import rest
from rewax.physics.tets.stepping import split as split_vertices

Scene = MPMScene | TetScene
Soft = TypeVar("Soft", MPMState, TetState)
SCENE = instance((MPMScene, TetScene), "give a scene of mpm.make_scene or tets.make_scene")
STATE = instance((MPMState, TetState), "give a state of mpm.initial_state or tets.initial_state")


class Solver(NamedTuple):
    """Functions that advance a soft body. ``soft`` is its state by components, for the inner loop."""

    constants: Callable[[Any, Any], Any]
    """``(scene, state) -> constants``: values that all substeps of a step share."""
    split: Callable[[Any], Any]
    """``state -> soft``."""
    join: Callable[[Any], Any]
    """``soft -> state``."""
    begin: Callable[[Any, Any, Any], SoftContact]
    """``(scene, constants, soft) -> contact``: the part of a substep before contact with bodies."""


PARTICLES = Solver(lambda scene, state: nodes_of_step(scene, state.x), split_particles, join_particles, nodes.begin)
TETRAHEDRA = Solver(lambda scene, state: rest(scene), split_vertices, join_vertices, vertices.begin)


def solver_of(scene: Scene) -> Solver:
    """The solver of a scene.

    Raises:
      ValueError: it is no scene.
    """
    SCENE("scene", scene)
    return PARTICLES if isinstance(scene, MPMScene) else TETRAHEDRA


__all__ = ["PARTICLES", "SCENE", "STATE", "TETRAHEDRA", "Scene", "Soft", "Solver", "solver_of"]
