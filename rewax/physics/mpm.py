"""The moving least squares material point method: state, substep, step, largest stable substep.

One substep: return map and stress, particle to grid, gravity and contact on the grid, grid to particle. A step is a
``scan`` of substeps in which the backward pass recomputes instead of storing, so memory grows with the number of
stored substeps and not with their grids.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.physics import components as cp
from rewax.physics.active_nodes import REACH, ActiveNodes, all_nodes, count_nodes, list_nodes
from rewax.physics.colliders import Collider, Pose, Walls, apply_collider, apply_walls
from rewax.physics.components import Mat3, Vec3
from rewax.physics.grid import Grid
from rewax.physics.materialize import materialize
from rewax.physics.materials import Elasticity, Material, Plasticity, Response, respond, sound_speed
from rewax.physics.recompute import recomputed
from rewax.physics.transfer import GridFields, grid_to_particle, particle_to_grid
from rewax.status import Status, flag
from rewax.types import Array, Scalar

MIN_NODE_MASS = 1e-15
"""Nodes with less mass than this [kg] have velocity zero."""
STABLE_COURANT_NUMBER = 0.5
"""Largest tested-stable ratio of substep to the time sound takes through a cell; see ``largest_stable_dt``."""


@struct.dataclass
class MPMState(struct.Replaceable):
    """Particles.

    Attributes:
      x: position [m], shape (num_particles, 3).
      v: velocity [m/s], shape (num_particles, 3).
      C: affine velocity field around each particle [1/s], shape (num_particles, 3, 3).
      F: trial elastic deformation gradient [-], shape (num_particles, 3, 3): the next substep's return map is still
        to be applied.
      plastic_volume: volume ratio of all plastic flow so far [-], shape (num_particles,), if a material of the scene
        remembers it, else None.
    """

    x: Array
    v: Array
    C: Array
    F: Array
    plastic_volume: Array | None = None


@struct.dataclass
class MPMScene(struct.Replaceable):
    """Everything of a simulation that does not change with time; build it with ``make_scene``, which checks it.

    Attributes:
      grid: the nodes (static).
      dt: duration of a substep [s] (static).
      material: what the particles are made of; several, if they are of different kinds.
      particle_counts: with several materials, how many particles are of each, in their order (static).
      particle_volume: rest volume of each particle [m^3], shape () or (num_particles,).
      gravity: acceleration [m/s^2], shape (3,).
      colliders: moving shapes, applied in order.
      walls: the sides of the box.
      max_active_nodes: how many nodes can have a velocity in a step, None for all (static).
    """

    grid: Grid = struct.static_field()
    dt: float = struct.static_field()
    material: Material | tuple[Material, ...]
    particle_volume: Scalar
    gravity: Array
    particle_counts: tuple[int, ...] | None = struct.static_field(default=None)
    colliders: tuple[Collider, ...] = ()
    walls: Walls = Walls(lower=(None, None, None), upper=(None, None, None))
    max_active_nodes: int | None = struct.static_field(default=None)


class _Particles(NamedTuple):
    """``MPMState`` by components, as the inner loop wants it."""

    x: Vec3
    v: Vec3
    C: Mat3
    F: Mat3
    plastic_volume: Array | None


def initial_state(x: Array, scene: MPMScene | None = None) -> MPMState:
    """Undeformed particles at rest.

    Args:
      x: positions [m], shape (num_particles, 3).
      scene: what they are made of; needed where a material remembers its plastic flow (snow).
    """
    x = jnp.asarray(x)
    zeros = jnp.zeros((x.shape[0], 3, 3), x.dtype)
    remembers = scene is not None and any(m.remembers for m in _materials(scene))
    return MPMState(
        x=x,
        v=jnp.zeros_like(x),
        C=zeros,
        F=zeros + jnp.eye(3, dtype=x.dtype),
        plastic_volume=jnp.ones(x.shape[0], x.dtype) if remembers else None,
    )


def make_scene(
    *,
    grid: Grid,
    dt: float,
    material: Material | tuple[Material, ...],
    particle_volume: Scalar,
    particle_counts: tuple[int, ...] | None = None,
    gravity: Any = (0.0, -9.81, 0.0),
    colliders: tuple[Collider, ...] = (),
    walls: Walls = Walls(lower=(None, None, None), upper=(None, None, None)),
    max_active_nodes: int | None = None,
) -> MPMScene:
    """A checked ``MPMScene``; arguments are its fields.

    ``max_active_nodes`` makes memory and grid work of a step grow with the body instead of the box: nodes have a
    place only where particles can be while none moves by more than a cell within a step (not substep). It pays where
    a body fills little of its box; ``check_status`` tells when it was chosen too small.

    Raises:
      ValueError: a modulus, density, yield stress or volume that is not positive, a Poisson's ratio outside (-1, 0.5),
        a dt that is not positive or above ``largest_stable_dt``. The message names field, value and remedy. Inside
        ``jit`` (traced values) only static fields can be checked.
    """
    materials = material if isinstance(material, tuple) else (material,)
    for one in materials:
        _check_material(one)
    if (particle_counts is None) != isinstance(material, Material) or len(particle_counts or (0,)) != len(materials):
        raise ValueError(
            f"particle_counts is {particle_counts} with {len(materials)} materials: give a tuple of materials and how "
            "many particles are of each, in their order; or one material and no particle_counts"
        )
    _check_positive(
        "particle_volume", particle_volume, "give the body's rest volume over its number of particles, in m^3"
    )
    _check_positive("dt", dt, "give the duration of a substep in seconds")
    _check_max_active_nodes(max_active_nodes)
    for one in materials:
        limit = largest_stable_dt(one, grid)
        if not isinstance(limit, Tracer) and dt > float(np.min(limit)):
            raise ValueError(
                f"dt is {dt:g} s, above the largest stable {float(np.min(limit)):.3g} s for this material on a grid of "
                f"spacing {grid.spacing:g} m: take more substeps of smaller dt, a softer or denser material, "
                "or a coarser grid"
            )
    return MPMScene(
        grid=grid,
        dt=dt,
        material=material,
        particle_volume=particle_volume,
        particle_counts=particle_counts,
        gravity=jnp.asarray(gravity),
        colliders=colliders,
        walls=walls,
        max_active_nodes=max_active_nodes,
    )


def largest_stable_dt(material: Material, grid: Grid, max_speed: Scalar = 0.0) -> Scalar:
    """Largest substep [s] at which the explicit integration stays stable: 0.5 spacing / (sound speed + max_speed).

    The factor is measured, for elastic blocks of two to eight particles per cell, random and regular, over 2000
    substeps: they blow up between 0.7 of the time that sound takes through a cell (two random particles per cell, nu
    0.45, initial velocities of 5 % of the speed of sound) and 1.2 (eight regular ones, nu 0.2), nearly whatever the
    law. Strong compression makes sound faster: it needs a margin of its own. So do viscosity and the hardening of snow,
    which do not count here, and Tait's law and the reference's fluid, for which the factor was not measured.

    Args:
      material: its stiffness and density set the speed of sound.
      grid: its spacing.
      max_speed: largest particle speed expected [m/s].

    Gradient: exact.
    """
    return STABLE_COURANT_NUMBER * grid.spacing / (sound_speed(material) + max_speed)


def substep(scene: MPMScene, state: MPMState, before: Pose, after: Pose) -> MPMState:
    """One substep of duration ``scene.dt``.

    Args:
      scene: the scene.
      state: particles.
      before, after: poses of all bodies at its beginning and end, shapes (num_bodies, 3), (num_bodies, 3, 3).

    Gradient: exact with respect to the state, the poses and every leaf of the scene, forward and reverse.
    Source: Hu et al. 2018, "A moving least squares material point method", algorithm 1.
    """
    nodes = _nodes(scene, state.x)
    return _join(_recomputed_substep(scene, nodes, _split(state), (before, after)))


def step(scene: MPMScene, state: MPMState, poses: Pose, *, store_every: int | None = 1) -> MPMState:
    """As many substeps as ``poses`` has intervals.

    Args:
      scene: the scene.
      state: particles.
      poses: poses of all bodies at the num_substeps + 1 boundaries of substeps, shapes (num_substeps + 1, num_bodies,
        3) and (num_substeps + 1, num_bodies, 3, 3); see ``static_poses`` for a scene without bodies.
      store_every: how the backward pass gets its intermediate values. A number k, which must divide the number of
        substeps: particles are stored every k substeps and everything else is recomputed (k = 1 recomputes each
        substep once; larger k stores less and recomputes twice). None: everything is stored, fastest and largest.

    Gradient: exact, as for ``substep``.
    """
    num_substeps = poses.position.shape[0] - 1
    if store_every is not None and (store_every < 1 or num_substeps % store_every):
        raise ValueError(
            f"store_every is {store_every} with {num_substeps} substeps: give a number that divides them, or None"
        )
    nodes = _nodes(scene, state.x)
    intervals = (jax.tree.map(lambda p: p[:-1], poses), jax.tree.map(lambda p: p[1:], poses))

    one = _substep if store_every is None else _recomputed_substep

    def body(particles: _Particles, interval: tuple[Pose, Pose]) -> tuple[_Particles, None]:
        return one(scene, nodes, particles, interval), None

    def chunk(particles: _Particles, intervals: tuple[Pose, Pose]) -> tuple[_Particles, None]:
        return jax.lax.scan(body, particles, intervals)

    if store_every is None or store_every == 1:
        return _join(chunk(_split(state), intervals)[0])
    chunks = jax.tree.map(lambda p: p.reshape(num_substeps // store_every, store_every, *p.shape[1:]), intervals)
    return _join(jax.lax.scan(jax.checkpoint(chunk), _split(state), chunks)[0])


def static_poses(num_substeps: int, num_bodies: int = 0, dtype: Any = None) -> Pose:
    """Poses of bodies that stay at the origin for all boundaries of substeps."""
    shape = (num_substeps + 1, num_bodies)
    return Pose(jnp.zeros((*shape, 3), dtype), jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*shape, 3, 3)))


def check_status(scene: MPMScene, state: MPMState, *, start: MPMState | None = None) -> Array:
    """Status bits of a state: non-finite numbers, particles at the box's border or faster than a cell per substep.

    Args:
      scene: the scene.
      state: particles at the end of a step.
      start: particles at its beginning, to also tell whether the scene's ``max_active_nodes`` sufficed.

    Returns:
      Bits of ``rewax.status.Status``, shape (), int32. Gradient: none.
    """
    state = jax.lax.stop_gradient(state)
    lower, upper = _bounds(scene.grid, state.x.dtype)
    finite = jnp.all(jnp.isfinite(state.x)) & jnp.all(jnp.isfinite(state.v)) & jnp.all(jnp.isfinite(state.F))
    at_border = jnp.any((state.x <= lower) | (state.x >= upper))
    too_fast = jnp.any(jnp.abs(state.v) * scene.dt > scene.grid.spacing)
    status = flag(~finite, Status.NAN) | flag(at_border, Status.OUT_OF_DOMAIN) | flag(too_fast, Status.CFL)
    if start is None:
        return status
    if scene.max_active_nodes is None:
        return status
    before = jax.lax.stop_gradient(start).x
    too_few = count_nodes(scene.grid, before) > scene.max_active_nodes
    too_far = jnp.any(jnp.abs(state.x - before) > REACH * scene.grid.spacing)
    return status | flag(too_few | too_far, Status.INACTIVE_NODES)


def deform(scene: MPMScene, state: MPMState) -> tuple[Array, Array]:
    """Elastic deformation gradient after the pending return map [-] and its Kirchhoff stress [Pa], (N, 3, 3) each."""
    response = _respond(scene, _split(state))
    return cp.join_matrix(response.F), cp.join_matrix(response.stress)


# --- One substep, by components --------------------------------------------------------------------------------------


def _substep(scene: MPMScene, nodes: ActiveNodes, particles: _Particles, interval: tuple[Pose, Pose]) -> _Particles:
    # Stored once: the backward pass slices them out of what the forward pass kept, and would do so in every user.
    particles = materialize(particles)
    x, v, C, F_trial, plastic_volume = particles
    grid, dt = scene.grid, scene.dt
    active = None if scene.max_active_nodes is None else nodes
    inertia = 4.0 / grid.spacing**2
    volume = scene.particle_volume
    mass = particle_mass(scene, x[0])
    impulse = -dt * inertia * volume
    with jax.named_scope("law"):
        F, tau, plastic_volume = materialize(_respond(scene, particles))
        affine = cp.matrix(lambda i, j: impulse * tau[i][j] + mass * C[i][j])
    with jax.named_scope("particle_to_grid"):
        fields = particle_to_grid(grid, x, mass, cp.vector(lambda i: mass * v[i]), affine, active=active)
    with jax.named_scope("grid"):
        velocity = grid_velocity(scene, nodes, fields, *interval)
    with jax.named_scope("grid_to_particle"):
        v, moment = materialize(grid_to_particle(grid, x, velocity, active=active))
    with jax.named_scope("update"):
        C = cp.matrix(lambda i, j: inertia * moment[i][j])
        CF = cp.matmul(C, F)
        F_trial = cp.matrix(lambda i, j: F[i][j] + dt * CF[i][j])
        lower, upper = grid.lower, grid.upper
        x = cp.vector(lambda i: jnp.clip(x[i] + dt * v[i], lower[i], upper[i]))
    return _Particles(x, v, C, F_trial, plastic_volume)


def _materials(scene: MPMScene) -> tuple[Material, ...]:
    return scene.material if isinstance(scene.material, tuple) else (scene.material,)


def per_material(scene: MPMScene, function: Callable[[Material, Any], Any], particles: Any) -> Any:
    """``function(material, particles)``, for each material with its own part of the particles.

    Args:
      scene: its materials and ``particle_counts``.
      function: from a material and a pytree of arrays of its particles to a pytree of arrays of these particles.
      particles: pytree of arrays with a first axis over all particles.

    Returns:
      The results for all particles, in their order.
    """
    if isinstance(scene.material, Material):
        return function(scene.material, particles)
    counts = scene.particle_counts
    assert counts is not None
    num_particles = jax.tree.leaves(particles)[0].shape[0]
    if sum(counts) != num_particles:
        raise ValueError(
            f"particle_counts is {counts}, in sum {sum(counts)}, but there are {num_particles} particles: "
            "make both agree"
        )
    results, start = [], 0
    for material, count in zip(scene.material, counts, strict=True):
        part = slice(start, start + count)
        results.append(function(material, jax.tree.map(lambda a, part=part: a[part], particles)))
        start += count
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *results)


def particle_mass(scene: MPMScene, x: Array) -> Array:
    """Mass of each of the particles at x [kg], any array with one entry per particle; shape (num_particles,).

    Gradient: exact with respect to volume and densities.
    """
    density = per_material(scene, lambda m, a: jnp.broadcast_to(m.density, a.shape[:1]).astype(a.dtype), x)
    return jnp.broadcast_to(scene.particle_volume * density, x.shape[:1]).astype(x.dtype)


def _respond(scene: MPMScene, particles: _Particles) -> Response:
    def one(material: Material, p: _Particles) -> Response:
        response = respond(material, p.F, velocity_gradient=p.C, plastic_volume=p.plastic_volume)
        # Beside snow, others keep the number that they do not use.
        return response if material.remembers else response._replace(plastic_volume=p.plastic_volume)

    return per_material(scene, one, particles)


_recomputed_substep = recomputed(_substep)


def grid_velocity(scene: MPMScene, nodes: ActiveNodes, fields: GridFields, before: Pose, after: Pose) -> Vec3:
    """Velocities of the given nodes [m/s] after gravity, colliders and walls, components of shape (num_nodes,).

    Gradient: exact with respect to fields, poses and every leaf of the scene.
    """
    has_mass = fields.mass > MIN_NODE_MASS
    inverse = jnp.where(has_mass, 1.0 / jnp.where(has_mass, fields.mass, 1.0), 0.0)
    velocity = cp.vector(lambda i: fields.momentum[i] * inverse + scene.dt * scene.gravity[i])
    for collider in scene.colliders:
        start, end = (Pose(p.position[collider.body], p.rotation[collider.body]) for p in (before, after))
        velocity = apply_collider(collider, nodes.position, velocity, start, end, scene.dt)
    velocity = apply_walls(scene.walls, scene.grid, nodes.index, velocity)
    return cp.vector(lambda i: jnp.where(has_mass, velocity[i], 0.0))


def _nodes(scene: MPMScene, x: Array) -> ActiveNodes:
    """The nodes that take part in the step that starts at positions x."""
    if scene.max_active_nodes is None:
        return all_nodes(scene.grid, x.dtype)
    return list_nodes(scene.grid, x, scene.max_active_nodes)


def _split(state: MPMState) -> _Particles:
    return _Particles(
        cp.split_vector(state.x),
        cp.split_vector(state.v),
        cp.split_matrix(state.C),
        cp.split_matrix(state.F),
        state.plastic_volume,
    )


def _join(p: _Particles) -> MPMState:
    return MPMState(
        x=cp.join_vector(p.x),
        v=cp.join_vector(p.v),
        C=cp.join_matrix(p.C),
        F=cp.join_matrix(p.F),
        plastic_volume=p.plastic_volume,
    )


def _bounds(grid: Grid, dtype: Any) -> tuple[Array, Array]:
    return jnp.asarray(grid.lower, dtype), jnp.asarray(grid.upper, dtype)


# --- Checks ----------------------------------------------------------------------------------------------------------


def _check_max_active_nodes(max_active_nodes: int | None) -> None:
    if max_active_nodes is not None and max_active_nodes < 27:
        raise ValueError(
            f"max_active_nodes is {max_active_nodes}: give at least the 27 that one particle touches, or None for all"
        )


def _check_material(material: Material) -> None:
    _check_positive("density", material.density, "give the rest density in kg/m^3")
    if material.elasticity is Elasticity.TAIT:
        _check_positive("speed_of_sound", material.speed_of_sound, "give the fluid's speed of sound in m/s")
    else:
        _check_positive("youngs_modulus", material.youngs_modulus, "give Young's modulus in Pa")
    if material.plasticity is Plasticity.VON_MISES:
        _check_positive("yield_stress", material.yield_stress, "give the von Mises yield stress in Pa")
    if material.plasticity is Plasticity.SNOW:
        remedy = (
            "give a positive number (fresh snow: critical_compression 0.025, critical_stretch 0.0075, hardening 10)"
        )
        for name in ("critical_compression", "critical_stretch", "hardening"):
            _check_positive(name, getattr(material, name), remedy)
    remedy = "give a value above -1 and below 0.5 (0.5 is incompressible; take 0.45 for rubber)"
    _check_range("poissons_ratio", material.poissons_ratio, (-1.0, 0.5), remedy)
    if material.plasticity is Plasticity.DRUCKER_PRAGER:
        remedy = "give an angle in radians between 0 and pi / 2 (dry sand: 0.5)"
        _check_range("friction_angle", material.friction_angle, (0.0, 0.5 * np.pi), remedy)
    not_negative = (np.nextafter(0.0, -1.0), np.inf)
    if material.cohesion is not None:
        _check_range("cohesion", material.cohesion, not_negative, "give a strain of 0 or more")
    if material.viscosity is not None:
        _check_range("viscosity", material.viscosity, not_negative, "give the dynamic viscosity in Pa s, 0 or more")


def _check_range(name: str, value: Any, limits: tuple[float, float], remedy: str) -> None:
    if isinstance(value, Tracer):
        return
    if value is None or not np.all((np.asarray(value) > limits[0]) & (np.asarray(value) < limits[1])):
        raise ValueError(f"{name} is {value if value is None else np.asarray(value)}: {remedy}")


def _check_positive(name: str, value: Any, remedy: str) -> None:
    if isinstance(value, Tracer):
        return
    if value is None or not np.all(np.asarray(value) > 0):
        shown = value if value is None else np.asarray(value)
        raise ValueError(f"{name} is {shown}, but must be positive: {remedy}")
