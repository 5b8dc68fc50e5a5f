"""The solvers of soft bodies that can be coupled, through the interface that ``free`` and ``articulated`` use."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from rewax.physics.coupling import mixed_contact, nodes, sheets, vertices
from rewax.physics.coupling.exchange import SoftContact
from rewax.physics.coupling.mixed import MixedScene, MixedState
from rewax.physics.mpm.packing import join as join_particles
from rewax.physics.mpm.packing import split as split_particles
from rewax.physics.mpm.scene import MPMScene, MPMState
from rewax.physics.mpm.scene import check_state as check_particles
from rewax.physics.mpm.stepping import nodes_of_step
from rewax.physics.numerics.fields import instance
from rewax.physics.numerics.substeps import scan_substeps
from rewax.physics.tets.scene import TetScene, TetState, check_vertices
from rewax.physics.tets.stepping import join as join_vertices
from rewax.physics.tets.stepping import rest
from rewax.physics.tets.stepping import split as split_vertices
from rewax.physics.thin.prescribed import Prescribed, checked_prescribed
from rewax.physics.thin.scene import ThinScene, ThinState
from rewax.physics.thin.scene_checks import check_can_couple, check_creases
from rewax.physics.thin.self_contact import scan_rounds, watched_pairs
from rewax.physics.thin.stepping import join as join_thin
from rewax.physics.thin.stepping import remembered
from rewax.physics.thin.stepping import split as split_thin

Scene = MPMScene | TetScene | ThinScene | MixedScene
Soft = TypeVar("Soft", MPMState, TetState, ThinState, MixedState)
C = TypeVar("C")
SCENE = instance(
    (MPMScene, TetScene, ThinScene, MixedScene),
    "give a scene of mpm.make_scene, tets.make_scene, thin.make_scene or coupling.make_mixed_scene",
)
STATE = instance(
    (MPMState, TetState, ThinState, MixedState),
    "give a state of mpm.initial_state, tets.initial_state or thin.initial_state, or a MixedState",
)


class Solver(NamedTuple):
    """Functions that advance a soft body. ``soft`` is its state by components, for the inner loop."""

    constants: Callable[[Any, Any], Any]
    """``(scene, state) -> constants``: values that all substeps of a step share."""
    split: Callable[[Any], Any]
    """``state -> soft``."""
    join: Callable[[Any], Any]
    """``soft -> state``."""
    begin: Callable[..., SoftContact]
    """``(scene, constants, soft, prescribed) -> contact``: the part of a substep before contact with bodies."""
    every: Callable[[Any], int | None] = lambda scene: None
    """``scene -> every``: constants are searched anew after this number of substeps; None: never."""
    search: Callable[[Any, Any, Any], tuple[Any, Any]] = lambda scene, constants, soft: (constants, None)
    """``(scene, constants, soft) -> constants, watch``: those for the next substeps, and ``watch(end, substeps)`` for
    the numbers to be remembered of them, see ``scan_rounds``."""
    remember: Callable[[Any, Any, Any], Any] = lambda before, after, seen: after
    """``(before, after, seen) -> after``: the state after a step that keeps the largest numbers of all searches."""


PARTICLES = Solver(
    lambda scene, state: nodes_of_step(scene, state.x),
    split_particles,
    join_particles,
    lambda scene, constants, soft, prescribed=None: nodes.begin(scene, constants, soft),
)
TETRAHEDRA = Solver(
    lambda scene, state: rest(scene),
    split_vertices,
    join_vertices,
    lambda scene, constants, soft, prescribed=None: vertices.begin(scene, constants, soft),
)
THIN = Solver(
    lambda scene, state: None,
    split_thin,
    join_thin,
    sheets.begin,
    lambda scene: None if scene.self_contact is None else scene.self_contact.every,
    lambda scene, constants, soft: watched_pairs(scene, soft),
    remembered,
)
MIXED = Solver(
    mixed_contact.constants_of,
    mixed_contact.split,
    mixed_contact.join,
    mixed_contact.begin,
    mixed_contact.every_of,
    mixed_contact.search,
    mixed_contact.remembered,
)


def solver_of(scene: Scene) -> Solver:
    """The solver of a scene.

    Raises:
      ValueError: it is no scene.
    """
    SCENE("scene", scene)
    solvers = {MPMScene: PARTICLES, TetScene: TETRAHEDRA, ThinScene: THIN, MixedScene: MIXED}
    return next(solver for kind, solver in solvers.items() if isinstance(scene, kind))


def touched_bodies(scene: Scene) -> list[int]:
    """Bodies that act on a soft body, ascending."""
    grasps = scene.grasps if isinstance(scene, ThinScene | MixedScene) else ()
    return sorted({part.body for part in (*scene.colliders, *grasps)})


_STATES = {MPMScene: MPMState, TetScene: TetState, ThinScene: ThinState, MixedScene: MixedState}


def check_state(scene: Scene, state: Any) -> None:
    """Raises ValueError for the state of another solver than the scene's, and for arrays that do not fit the scene."""
    want = next(state for kind, state in _STATES.items() if isinstance(scene, kind))
    if not isinstance(state, want):
        raise ValueError(
            f"state is a {type(state).__name__}, but scene a {type(scene).__name__}: give a {want.__name__}"
        )
    if isinstance(scene, MPMScene):
        check_particles(scene, state)
    elif isinstance(scene, TetScene):
        check_vertices(scene, state)
    elif isinstance(scene, MixedScene):
        check_particles(scene.particles, state.particles)


def prescribed_of(scene: Scene, state: Any, pins: Any, grips: Any, num_substeps: int, num_bodies: int) -> Prescribed:
    """Pins and grips of every substep of the soft body.

    Raises:
      ValueError: another shape than ``thin.step`` says, pins or grips for a soft body that has none, a state of another
        solver than the scene's, or cloth with implicit steps or creases.
    """
    check_state(scene, state)
    if isinstance(scene, MixedScene):
        scene, state = scene.thin, state.thin
    if isinstance(scene, ThinScene):
        check_can_couple(scene.stepper, scene.cloth)
        check_creases(scene.cloth, scene.topology, state.crease)
        return checked_prescribed(scene, state, pins, grips, num_substeps, num_bodies)
    if pins is not None or grips is not None:
        raise ValueError(
            f"{'grips' if pins is None else 'pins'} is given, but the scene has no cloth and no ropes: leave it out"
        )
    return Prescribed()


def scan_soft(
    scene: Scene,
    constants: Any,
    substep: Callable[[C, Any, Any], C],
    carry: C,
    intervals: Any,
    store_every: int | None,
) -> tuple[C, Any]:
    """``carry = substep(carry, interval, constants)`` for each substep, see ``substeps.scan_substeps``.

    ``carry.soft`` is the soft body; ``intervals`` holds at least one array. Also returns what ``Solver.remember``
    takes.
    """
    solver = solver_of(scene)
    every = solver.every(scene)
    if every is None:
        return scan_substeps(lambda c, interval: substep(c, interval, constants), carry, intervals, store_every), None

    def search(carry: Any) -> tuple[Any, Any]:
        found, watch = solver.search(scene, constants, carry.soft)
        return found, lambda end, substeps: watch(end.soft, substeps)

    return scan_rounds(substep, search, carry, intervals, store_every, every)


__all__ = ["MIXED", "PARTICLES", "SCENE", "STATE", "TETRAHEDRA", "THIN", "Scene", "Soft", "Solver", "prescribed_of",
           "scan_soft", "solver_of", "touched_bodies"]  # fmt: skip
