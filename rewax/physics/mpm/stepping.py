"""The moving least squares material point method: substep, step, status.

One substep: return map and stress, particle to grid (P2G), gravity and contact on the grid, grid to particle (G2P). A
step is a ``scan`` of substeps. The backward pass recomputes each substep instead of storing its grid, so memory grows
with the number of stored particle states.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.lowering.kernels import pointwise
from rewax.lowering.recompute import recomputed
from rewax.physics.contact.broad_phase import count_excess, near_colliders
from rewax.physics.contact.colliders import Collider, apply_colliders, check_bodies, place
from rewax.physics.contact.motion import Placed
from rewax.physics.contact.penetration import penetration
from rewax.physics.mpm.active_nodes import ActiveNodes, all_nodes, count_nodes, list_nodes
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.materials import Material, Response, is_inverted, joined_parameters, respond, split_parameters
from rewax.physics.mpm.packing import Particles, join, pack, rows_of, split, unpack
from rewax.physics.mpm.scene import (
    SCENE,
    STABLE_COURANT_NUMBER,
    STATE,
    MPMScene,
    MPMState,
    check_placement,
    check_state,
    has_invalid_parameters,
    initial_state,
    largest_stable_dt,
    least_particle_mass,
    make_scene,
    particle_mass,
    per_material,
)
from rewax.physics.mpm.transfer import GridFields, grid_to_particle, particle_to_grid
from rewax.physics.mpm.transfer_xla_cpu import as_matrix
from rewax.physics.mpm.walls import apply_walls
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import check_precision
from rewax.physics.numerics.components import Mat3, Vec3
from rewax.physics.numerics.fields import checked, instance, optional, poses
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.substeps import both_ends, scan_substeps
from rewax.status import Status, all_finite, flag
from rewax.types import Array, Scalar

DEEP_IN_CELLS = 1.5
"""Depth inside a collider from which a particle sets ``PENETRATION`` [cells]: all nodes that move it lie inside."""
MIN_NODE_MASS = 2e-11
"""Nodes with less than this fraction of a particle's mass [-] have velocity zero."""


_POSES = poses("num_substeps + 1", "num_bodies")


@checked(scene=SCENE, state=STATE, before=poses("num_bodies"), after=poses("num_bodies"))
def substep(
    scene: MPMScene, state: MPMState, before: Pose, after: Pose, *, nodes: ActiveNodes | None = None
) -> MPMState:
    """One substep of duration ``scene.dt``.

    Args:
      scene: the scene.
      state: particles.
      before, after: poses of all bodies at its beginning and end, shapes (num_bodies, 3), (num_bodies, 3, 3).
      nodes: active nodes, if known from the step's start (``nodes_of_step``); None: computed here.

    Gradient: exact with respect to the state, the poses and every leaf of the scene, forward and reverse. The onset of
      a node's contact is a step that no derivative sees, see ``contact.apply_collider``.
    Source: Hu et al. 2018, "A moving least squares material point method", algorithm 1.

    Raises:
      ValueError: the state or the poses do not fit the scene.
    """
    check_state(scene, state)
    check_bodies(scene.colliders, before.position.shape[0])
    nodes = nodes_of_step(scene, state.x) if nodes is None else nodes
    return join(_recomputed_substep(scene, nodes, split(state), place(scene.colliders, before, after, scene.dt)))


@checked(scene=SCENE, state=STATE, poses=_POSES)
def step(scene: MPMScene, state: MPMState, poses: Pose, *, store_every: int | None = 1) -> MPMState:
    """Advance particles by the substeps between ``poses``.

    Args:
      scene: the scene.
      state: particles.
      poses: poses of all bodies at the num_substeps + 1 boundaries of substeps, shapes (num_substeps + 1, num_bodies,
        3) and (num_substeps + 1, num_bodies, 3, 3); see ``static_poses`` for a scene without bodies.
      store_every: what the backward pass stores. An integer k that divides the number of substeps: particles every k
        substeps, and everything else is recomputed (once for k = 1, twice for larger k). None: everything, which is
        fastest and takes most memory.

    Gradient: exact, as for ``substep``. Source: as for ``substep``.

    Raises:
      ValueError: as for ``substep``; ``store_every`` does not divide the substeps; state and scene differ in precision.
    """
    check_state(scene, state)
    check_bodies(scene.colliders, poses.position.shape[1])
    check_precision(state.x, scene.gravity, poses.position)
    nodes = nodes_of_step(scene, state.x)
    one = _substep if store_every is None else _recomputed_substep

    def body(packed: Array, placed: Placed) -> Array:
        return one(scene, nodes, packed, placed)

    placed = place(scene.colliders, *both_ends(poses), scene.dt)
    return join(scan_substeps(body, split(state), placed, store_every))


@checked(scene=SCENE, state=STATE, start=optional(STATE), poses=optional(instance(Pose, "give a Pose, or None")))
def check_status(
    scene: MPMScene, state: MPMState, *, start: MPMState | None = None, poses: Pose | None = None
) -> Array:
    """Status bits of a state (non-finite numbers, particles at the box's border, inverted or too fast) and of a scene
    (illegal numbers).

    Args:
      scene: the scene.
      state: particles at the end of a step.
      start: particles at its beginning. Required with ``max_active_nodes``, to check that the nodes sufficed.
      poses: poses of the bodies, as for ``step``, to check that they are finite, that no particle is more than 1.5
        cells inside a collider at the end and, given ``start``, that ``max_near_colliders`` sufficed. Coupled scenes
        evaluate all colliders, and their bodies yield: omit poses there.

    Returns:
      Bits of ``rewax.status.Status``, shape (), int32. Gradient: none.

    Raises:
      ValueError: ``start`` is None where it is required.
    """
    if start is None and scene.max_active_nodes is not None:
        raise ValueError(
            f"start is None with a scene of max_active_nodes {scene.max_active_nodes}: give the particles at the "
            "beginning of the step, check_status(scene, state, start=before), to tell whether these nodes sufficed"
        )
    for given in (state,) if start is None else (state, start):
        check_state(scene, given)
    if poses is not None:
        check_bodies(scene.colliders, poses.position.shape[-2])
    state = jax.lax.stop_gradient(state)
    lower, upper = _bounds(scene.grid, state.x.dtype)
    at_border = jnp.any((state.x <= lower) | (state.x >= upper))
    too_fast = jnp.any(jnp.abs(state.v) * scene.dt > scene.grid.spacing)
    inverted = jnp.any(per_material(scene, lambda m, part: is_inverted(m, *part), (state.F, state.memory)))
    status = (
        flag(~all_finite(state), Status.NAN)
        | flag(at_border, Status.OUT_OF_DOMAIN)
        | flag(too_fast, Status.CFL)
        | flag(inverted, Status.INVERTED)
        | flag(has_invalid_parameters(scene, poses), Status.INVALID_PARAMETERS)
    )
    before = state.x if start is None else jax.lax.stop_gradient(start).x
    if poses is not None and scene.max_near_colliders is not None:
        if start is None:
            raise ValueError("start is None: give the particles at the beginning of the step that poses belong to")
        both = jnp.concatenate([state.x, before])
        # Nodes with mass are within 1.5 cells of a particle, and a particle may move by a cell in between.
        lower, upper = (
            jnp.min(both, axis=0) - 2.5 * scene.grid.spacing,
            jnp.max(both, axis=0) + 2.5 * scene.grid.spacing,
        )
        excess = count_excess(scene.sized_colliders, poses, lower, upper, scene.max_near_colliders)
        status = status | flag(excess > 0, Status.FAR_COLLIDERS)
    if poses is not None and scene.colliders:
        depth = penetration(scene.colliders, Pose(*(a[-1] for a in poses)), cp.split_vector(state.x))
        status = status | flag(depth > DEEP_IN_CELLS * scene.grid.spacing, Status.PENETRATION)
    return status | flag(nodes_missed(scene, before, state.x), Status.INACTIVE_NODES)


@checked(scene=SCENE, state=STATE)
def deform(scene: MPMScene, state: MPMState) -> tuple[Array, Array]:
    """Elastic deformation gradient [-] and Kirchhoff stress [Pa] after the pending return map, (num_particles, 3, 3).

    Gradient: exact.
    """
    deformed = respond_particles(scene, state)
    return deformed.F, deformed.stress


class DeformedParticles(NamedTuple):
    """Particles after the pending return map."""

    F: Array
    """Elastic deformation gradient [-], shape (num_particles, 3, 3)."""
    stress: Array
    """Kirchhoff stress [Pa], shape (num_particles, 3, 3)."""
    memory: tuple[Array, ...]
    """History variables, k arrays of shape (num_particles,)."""


def respond_particles(scene: MPMScene, state: MPMState) -> DeformedParticles:
    """Return map and stress of all particles. Gradient: exact."""
    check_state(scene, state)
    response = per_material(scene, _response, unpack(split(state)))
    return DeformedParticles(cp.join_matrix(response.F), cp.join_matrix(response.stress), response.memory)


# --- One substep, by components --------------------------------------------------------------------------------------


class Deformed(NamedTuple):
    """Particles between the halves of a substep."""

    x: Vec3
    """Positions [m]."""
    memory: Array
    """Deformation gradients after plastic flow [-], then history variables, (9 + k, num_particles)."""


def _substep(scene: MPMScene, nodes: ActiveNodes, packed: Array, placed: Placed) -> Array:
    deformed, fields = to_nodes(scene, nodes, packed)
    with jax.named_scope("grid"):
        velocity = grid_velocity(scene, nodes, fields, placed)
    return from_nodes(scene, nodes, deformed, velocity)


def to_nodes(scene: MPMScene, nodes: ActiveNodes, packed: Array) -> tuple[Deformed, GridFields]:
    """First half of a substep: return map, stress, and P2G of mass and momentum. Gradient: exact."""
    mass = particle_mass(scene, packed[0])
    volume = jnp.broadcast_to(scene.particle_volume, mass.shape).astype(mass.dtype)
    factor = -scene.dt * _inertia(scene.grid)

    def one(material: Material, part: tuple[Array, Array, Array]) -> tuple[Deformed, Mat3, Vec3]:
        shared, own = split_parameters(material)
        return stress_and_momentum((shared, factor), (own, *part))

    with jax.named_scope("law"):
        deformed, affine, momentum = per_material(scene, one, (packed, mass, volume), axis=-1)
    with jax.named_scope("particle_to_grid"):
        return deformed, particle_to_grid(scene.grid, deformed.x, mass, momentum, affine, active=_active(scene, nodes))


@pointwise
def stress_and_momentum(
    shared: tuple[Material, Scalar], particles: tuple[dict[str, Array], Array, Array, Array]
) -> tuple[Deformed, Mat3, Vec3]:
    """Response of one material, and the momentum that its particles send to the nodes.

    Args:
      shared: the material without its parameters per particle; -dt times the inverse of the splines' second moment
        [s/m^2].
      particles: the material's parameters per particle; packed particles; their masses [kg] and rest volumes [m^3].

    Returns:
      The particles; the affine field of momentum around each [kg/s]; the momentum of each [kg m/s].

    Gradient: exact.
    """
    (material, factor), (own, packed, mass, volume) = shared, particles
    material = joined_parameters(material, own)
    # Materialized: the backward pass would slice the stored array again in every operation that reads it.
    p = materialize(unpack(packed))
    response = materialize(_response(material, p))
    impulse = factor * volume
    affine = cp.matrix(lambda i, j: impulse * response.stress[i][j] + mass * p.C[i][j])
    memory = pack((response.F, response.memory))
    return Deformed(p.x, memory), affine, cp.vector(lambda i: mass * p.v[i])


def from_nodes(scene: MPMScene, nodes: ActiveNodes, deformed: Deformed, velocity: Vec3) -> Array:
    """Second half of a substep: G2P of node velocities [m/s], then motion and deformation. Gradient: exact."""
    grid = scene.grid
    with jax.named_scope("grid_to_particle"):
        v, moment = grid_to_particle(grid, deformed.x, velocity, active=_active(scene, nodes))
    with jax.named_scope("update"):
        return _moved((scene.dt, _inertia(grid), grid.lower, grid.upper), (deformed, v, moment))


@pointwise
def _moved(
    shared: tuple[Scalar, Scalar, Sequence[Scalar], Sequence[Scalar]], particles: tuple[Deformed, Vec3, Mat3]
) -> Array:
    (dt, inertia, lower, upper), (deformed, v, moment) = shared, particles
    v, moment = materialize((v, moment))
    rows = rows_of(deformed.memory)
    F, C = as_matrix(rows[:9]), cp.matrix(lambda i, j: inertia * moment[i][j])
    CF = cp.matmul(C, F)
    x = cp.vector(lambda i: jnp.clip(deformed.x[i] + dt * v[i], lower[i], upper[i]))
    return pack(Particles(x, v, C, cp.matrix(lambda i, j: F[i][j] + dt * CF[i][j]), tuple(rows[9:])))


def grid_velocity(scene: MPMScene, nodes: ActiveNodes, fields: GridFields, placed: Placed) -> Vec3:
    """Velocities of the given nodes [m/s] after gravity, colliders and walls, components of shape (num_nodes,).

    ``placed`` holds the placements of all the scene's colliders. Gradient: exact with respect to fields, placements and
    every leaf of the scene.
    """
    has_mass, velocity = free_velocity(scene, fields)
    colliders = colliders_at(scene, nodes, has_mass, placed)
    velocity = apply_colliders(colliders, nodes.position, velocity, overlap=scene.overlap)
    velocity = apply_walls(scene.walls, scene.grid, nodes.index, velocity)
    return where_mass(has_mass, velocity)


@recomputed  # a few elementwise operations: XLA fuses them with their neighbours, which is faster than C++
def where_mass(has_mass: Array, velocity: Vec3) -> Vec3:
    """Velocity zero at nodes without mass. Gradient: exact."""
    return cp.vector(lambda i: jnp.where(has_mass, velocity[i], 0.0))


def colliders_at(scene: MPMScene, nodes: ActiveNodes, has_mass: Array, placed: Placed) -> list[tuple[Collider, Placed]]:
    """The colliders to evaluate, with their placements."""
    colliders = scene.sized_colliders
    if scene.max_near_colliders is None or len(colliders) <= scene.max_near_colliders:
        return [(c, jax.tree.map(lambda a, i=i: a[i], placed)) for i, c in enumerate(colliders)]
    lower, upper = (
        jnp.stack([reduce(jnp.where(has_mass, a, far)) for a in nodes.position])
        for reduce, far in ((jnp.min, jnp.inf), (jnp.max, -jnp.inf))
    )
    return near_colliders(colliders, placed, lower, upper, scene.max_near_colliders)


def free_velocity(scene: MPMScene, fields: GridFields) -> tuple[Array, Vec3]:
    """Mask of nodes with mass, and node velocities [m/s] after gravity, before contact. Gradient: exact."""
    has_mass = fields.mass > MIN_NODE_MASS * least_particle_mass(scene, fields.mass.dtype)
    # Masses in a unit near the mass of a cell: in kg the derivative's 1 / mass^2 overflows float32 for small cells. The
    # unit is a power of two, so scaling is exact.
    unit = 2.0 ** round(-3.0 * math.log2(scene.grid.spacing))
    return has_mass, _free(unit, scene.dt, scene.gravity, has_mass, fields)


@recomputed  # as ``where_mass``
def _free(unit: float, dt: Scalar, gravity: Array, has_mass: Array, fields: GridFields) -> Vec3:
    inverse = jnp.where(has_mass, unit / jnp.where(has_mass, unit * fields.mass, 1.0), 0.0)
    return cp.vector(lambda i: fields.momentum[i] * inverse + dt * gravity[i])


def nodes_of_step(scene: MPMScene, x: Array) -> ActiveNodes:
    """The active nodes of the step that starts at positions x [m], shape (num_particles, 3). Gradient: none."""
    if scene.max_active_nodes is None:
        return all_nodes(scene.grid, x.dtype)
    return list_nodes(scene.grid, x, scene.max_active_nodes, reach=scene.reach)


def nodes_missed(scene: MPMScene, before: Array, after: Array) -> Array:
    """Whether ``nodes_of_step(scene, before)`` lacks nodes, or particles are too far for it after the step, shape (),
    bool."""
    if scene.max_active_nodes is None:
        return jnp.bool_(False)
    too_few = count_nodes(scene.grid, before, reach=scene.reach) > scene.max_active_nodes
    return too_few | jnp.any(jnp.abs(after - before) > scene.reach * scene.grid.spacing)


def _response(material: Material, p: Particles) -> Response:
    own = len(material.initial_memory)
    response = respond(material, p.F, velocity_gradient=p.C, memory=p.memory[:own])
    # Materials with fewer history variables pass the others through.
    return response._replace(memory=(*response.memory, *p.memory[own:]))


_recomputed_substep = recomputed(_substep)


def _active(scene: MPMScene, nodes: ActiveNodes) -> ActiveNodes | None:
    return None if scene.max_active_nodes is None else nodes


def _inertia(grid: Grid) -> float:
    """Inverse of the second moment of quadratic B-splines [1/m^2]."""
    return 4.0 / grid.spacing**2


def _bounds(grid: Grid, dtype: Any) -> tuple[Array, Array]:
    return jnp.asarray(grid.lower, dtype), jnp.asarray(grid.upper, dtype)


__all__ = [
    "MIN_NODE_MASS",
    "STABLE_COURANT_NUMBER",
    "Deformed",
    "MPMScene",
    "MPMState",
    "Particles",
    "check_placement",
    "check_status",
    "colliders_at",
    "deform",
    "free_velocity",
    "from_nodes",
    "grid_velocity",
    "initial_state",
    "largest_stable_dt",
    "make_scene",
    "nodes_of_step",
    "particle_mass",
    "per_material",
    "step",
    "substep",
    "to_nodes",
    "where_mass",
]
