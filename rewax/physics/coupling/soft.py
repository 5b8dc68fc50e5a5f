"""Which solvers of soft bodies can be coupled, and what the steps of ``free`` and ``articulated`` need of them."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from rewax.physics.coupling import nodes, vertices
from rewax.physics.coupling.exchange import SoftContact
from rewax.physics.mpm.packing import join as join_particles
from rewax.physics.mpm.packing import split as split_particles
from rewax.physics.mpm.scene import MPMScene, MPMState
from rewax.physics.mpm.stepping import nodes_of_step
from rewax.physics.tets.scene import TetScene, TetState
from rewax.physics.tets.stepping import join as join_vertices
from rewax.physics.tets.stepping import rest
from rewax.physics.tets.stepping import split as split_vertices

Scene = MPMScene | TetScene
Soft = TypeVar("Soft", MPMState, TetState)


class Solver(NamedTuple):
    """How a soft body is advanced. ``soft`` is its state by components, as the inner loop wants it."""

    constants: Callable[[Any, Any], Any]
    """``(scene, state) -> constants``: what is the same in all substeps of a step."""
    split: Callable[[Any], Any]
    """``state -> soft``."""
    join: Callable[[Any], Any]
    """``soft -> state``."""
    begin: Callable[[Any, Any, Any], SoftContact]
    """``(scene, constants, soft)``: a substep up to where bodies come in."""


PARTICLES = Solver(lambda scene, state: nodes_of_step(scene, state.x), split_particles, join_particles, nodes.begin)
TETRAHEDRA = Solver(lambda scene, state: rest(scene), split_vertices, join_vertices, vertices.begin)


def solver_of(scene: Scene) -> Solver:
    """The solver of a scene.

    Raises:
      ValueError: it is no scene.
    """
    if isinstance(scene, MPMScene):
        return PARTICLES
    if isinstance(scene, TetScene):
        return TETRAHEDRA
    raise ValueError(f"scene is {type(scene).__name__}: give one of mpm.make_scene or tets.make_scene")


__all__ = ["PARTICLES", "TETRAHEDRA", "Scene", "Soft", "Solver", "solver_of"]
