"""Particles (the state) and the scene (everything constant), checked when they are built."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.physics.contact.colliders import COLLIDERS, Collider, Overlap, check_bodies, shape_pose, with_softness
from rewax.physics.contact.contact_checks import check_rotations
from rewax.physics.mpm.active_nodes import REACHES
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.material_checks import MATERIAL, check_laws
from rewax.physics.mpm.materials import Material, sound_speed
from rewax.physics.mpm.scene_checks import (
    VOLUME,
    check_arrays,
    check_box,
    check_count,
    check_lengths,
    check_materials,
    part_numbers,
)
from rewax.physics.mpm.walls import Walls, check_before_walls, check_walls
from rewax.physics.numerics.checks import FINITE, GRAVITY, NOT_NEGATIVE, POSITIVE, any_illegal, check_numbers
from rewax.physics.numerics.fields import (
    check_fields,
    checked,
    instance,
    integer,
    member,
    one_of,
    optional,
    poses,
    real,
    static,
)
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.shapes import signed_distance
from rewax.types import Array, Scalar, Vector

OVERLAP = member(Overlap)
_GRID = instance(Grid, "give a Grid(shape=..., spacing=...)")
_SCENE = {
    "grid": _GRID,
    "dt": static(POSITIVE, "give the duration of a substep in seconds"),
    "colliders": COLLIDERS,
    "walls": instance(Walls, "give Walls(lower=..., upper=...)"),
    "max_active_nodes": optional(integer(27, "give at least the 27 that one particle touches, or None for all")),
    "reach": one_of(*REACHES),
    "max_near_colliders": optional(integer(1, "give at least 1, or None for all")),
    "overlap": OVERLAP,
}
STABLE_COURANT_NUMBER = 0.5
"""Largest ratio of dt to the time sound takes through a cell that tests show stable; see ``largest_stable_dt``."""
STABLE_DIFFUSION_NUMBER = 0.2
"""Largest viscosity dt / (density spacing^2) that tests show stable."""


@struct.dataclass
class MPMState(struct.Replaceable):
    """Particles.

    Attributes:
      x: position [m], shape (num_particles, 3).
      v: velocity [m/s], shape (num_particles, 3).
      C: affine velocity field around each particle [1/s], shape (num_particles, 3, 3), as in APIC.
      F: trial elastic deformation gradient [-], shape (num_particles, 3, 3), before the next substep's return map.
      memory: history variables of plasticity (``Plasticity.initial_memory``; snow: the plastic volume ratio [-]), shape
        (num_particles, k) with k the largest number among the scene's materials; None: no material has any.
    """

    x: Array
    v: Array
    C: Array
    F: Array
    memory: Array | None = None


@struct.dataclass
class MPMScene(struct.Replaceable):
    """The constant part of a simulation; build it with ``make_scene``, which checks it.

    Attributes:
      grid: the nodes (static).
      dt: duration of a substep [s] (static).
      material: the particles' material, or a tuple of several.
      particle_counts: with several materials, number of particles of each, in the particles' order (static).
      particle_volume: rest volume of each particle [m^3], shape () or (num_particles,).
      gravity: acceleration [m/s^2], shape (3,).
      colliders: moving shapes.
      overlap: how several colliders act on one node (static).
      max_near_colliders: number of colliders evaluated of each run of one kind, None for all (static).
      walls: the sides of the box.
      max_active_nodes: largest number of nodes with a velocity in a step, None for all (static).
      reach: with ``max_active_nodes``, cells that a particle may move along an axis within a step (static).
    """

    grid: Grid = struct.static_field()
    dt: float = struct.static_field()
    material: Material | tuple[Material, ...]
    particle_volume: Scalar = struct.number(POSITIVE, VOLUME)
    gravity: Vector = struct.number(FINITE, GRAVITY, shape=(3,))
    particle_counts: tuple[int, ...] | None = struct.static_field(default=None)
    colliders: tuple[Collider, ...] = ()
    walls: Walls = Walls(lower=(None, None, None), upper=(None, None, None))
    max_active_nodes: int | None = struct.static_field(default=None)
    reach: float = struct.static_field(default=1.0)
    overlap: Overlap = struct.static_field(default=Overlap.SEQUENTIAL)
    max_near_colliders: int | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        OVERLAP("overlap", self.overlap)

    @property
    def sized_colliders(self) -> tuple[Collider, ...]:
        """The colliders, with a reach of one cell where the softness is None."""
        return with_softness(self.colliders, self.grid.spacing)


SCENE = instance(MPMScene, "give a scene of mpm.make_scene")
STATE = instance(MPMState, "give a state of mpm.initial_state or mpm.step")


@checked(x=real(FINITE, "give positions in metres", shape=("num_particles", 3)), scene=optional(SCENE))
def initial_state(x: Array, scene: MPMScene | None = None) -> MPMState:
    """Undeformed particles at rest.

    Args:
      x: positions [m], shape (num_particles, 3).
      scene: the scene; required if a material has history variables (snow).

    Raises:
      ValueError: positions that are not finite or of another shape, particles outside the scene's box, or a number of
        particles that differs from the scene's ``particle_counts`` and arrays per particle. Inside ``jit`` only shapes
        are checked; ``check_status`` reports the rest.
    """
    x = jnp.asarray(x)
    x = x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)
    if x.shape[:1] == (0,):
        raise ValueError("x has no particles: give at least one")
    if scene is not None:
        check_box(scene.grid, x)
        _check_count(scene, x.shape[0])
    zeros = jnp.zeros((x.shape[0], 3, 3), x.dtype)
    return MPMState(
        x=x,
        v=jnp.zeros_like(x),
        C=zeros,
        F=zeros + jnp.eye(3, dtype=x.dtype),
        memory=None if scene is None else _initial_memory(scene, x),
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
    reach: float = 1.0,
    overlap: Overlap = Overlap.SEQUENTIAL,
    max_near_colliders: int | None = None,
) -> MPMScene:
    """A checked ``MPMScene``; the arguments are its fields.

    With ``max_active_nodes`` the memory and grid work of a step grow with the body instead of the box: only nodes that
    particles can reach are stored. A particle may then move by at most ``reach`` cells, 1 or 0.5, within a step (not
    substep). This pays if a body fills little of its box. ``check_status`` reports a number that was too small.

    With ``max_near_colliders`` only the colliders nearest to the particles are evaluated: this number of each run, that
    is, of consecutive colliders with one kind of shape. This pays with many colliders: 1.5 times as fast with 20
    capsules, 3 of them near. Given the step's poses, ``check_status`` reports a number that was too small. The two-way
    ``coupling`` evaluates all colliders.

    Raises:
      ValueError: an illegal value (not finite; a modulus, density, volume, size or softness that is not positive;
        friction below 0), walls that act on all nodes, a law whose methods return an illegal stiffness or viscosity,
        counts or arrays that do not fit together, a dt above ``largest_stable_dt``. The message names field, value and
        remedy. Inside ``jit`` only static fields and shapes are checked; ``check_status`` sets
        ``Status.INVALID_PARAMETERS`` for the rest.
    """
    check_fields(_SCENE, locals())
    materials = check_materials(material, particle_counts)
    check_rotations(colliders)
    check_numbers(part_numbers(materials, particle_volume, gravity, colliders, walls))
    check_lengths(materials, particle_counts, particle_volume)
    check_walls(walls, grid)
    dt = float(dt)
    for i, one in enumerate(materials):
        check_laws(one, f"material[{i}]." if len(materials) > 1 else "")
        limit = largest_stable_dt(one, grid)
        if not isinstance(limit, Tracer) and dt > float(np.min(limit)):
            raise ValueError(
                f"dt is {dt:g} s, above the largest stable {float(np.min(limit)):.3g} s for this material on a grid of "
                f"spacing {grid.spacing:g} m: take more substeps of smaller dt, a softer, denser or less viscous "
                "material, or a coarser grid"
            )
    return MPMScene(
        grid=grid,
        dt=dt,
        material=material,
        particle_volume=particle_volume,
        particle_counts=None if particle_counts is None else tuple(int(n) for n in particle_counts),
        gravity=gravity,
        colliders=tuple(colliders),
        walls=walls,
        max_active_nodes=None if max_active_nodes is None else int(max_active_nodes),
        reach=float(reach),
        overlap=overlap,
        max_near_colliders=None if max_near_colliders is None else int(max_near_colliders),
    )


@checked(material=MATERIAL, grid=_GRID, max_speed=real(NOT_NEGATIVE, "give a speed in m/s"))
def largest_stable_dt(material: Material, grid: Grid, max_speed: Scalar = 0.0) -> Scalar:
    """Largest substep [s] at which the explicit integration stays stable.

    The smaller of 0.5 spacing / (sound speed + max_speed) and, if viscous, 0.2 density spacing^2 / viscosity.

    Both factors are measured, over 2000 substeps of blocks at rest or with random velocities, with one to eight
    particles per cell. Elastic blocks become unstable between 0.7 times the time that sound takes through a cell (two
    random particles per cell, nu 0.45, initial velocities of 5 % of the speed of sound) and 1.2 times (eight regular
    particles, nu 0.2), nearly independent of the law. Viscous fluids and solids, at up to 0.5 of that time, become
    unstable between 0.25 and 0.6 of density spacing^2 / viscosity. Hardening materials count at their largest
    stiffness. Strong compression makes sound faster (in Tait's fluid by J^-4) and needs an extra margin.

    Args:
      material: stiffness, viscosity and density.
      grid: its spacing.
      max_speed: largest expected particle speed [m/s].

    Returns:
      Seconds, shape (), or (num_particles,) for parameters per particle.

    Raises:
      ValueError: ``max_speed`` is below 0, or an argument is of another class.

    Gradient: exact.
    """
    speed = sound_speed(material)
    if material.plasticity is not None and material.plasticity.largest_stiffness != 1.0:
        speed = speed * material.plasticity.largest_stiffness**0.5
    limit = STABLE_COURANT_NUMBER * grid.spacing / (speed + max_speed)
    if material.viscosity is None:
        return limit
    diffusivity = material.viscosity.dynamic_viscosity() / (
        STABLE_DIFFUSION_NUMBER * material.density * grid.spacing**2
    )
    return 1.0 / jnp.maximum(1.0 / limit, diffusivity)


def materials_of(scene: MPMScene) -> tuple[Material, ...]:
    return scene.material if isinstance(scene.material, tuple) else (scene.material,)


def per_material(scene: MPMScene, function: Callable[[Material, Any], Any], particles: Any, *, axis: int = 0) -> Any:
    """``function(material, particles)`` for each material, applied to its part of the particles.

    Args:
      scene: its materials and ``particle_counts``.
      function: maps a material and a pytree of arrays of its particles to a pytree of arrays of these particles.
      particles: pytree of arrays with an axis over all particles.
      axis: index of that axis, in the results too.

    Returns:
      The results for all particles, in their order.
    """
    if isinstance(scene.material, Material):
        return function(scene.material, particles)
    counts = scene.particle_counts
    assert counts is not None
    _check_count(scene, jax.tree.leaves(particles)[0].shape[axis])
    results, start = [], 0
    for material, count in zip(scene.material, counts, strict=True):

        def part(a: Array, start: int = start, count: int = count) -> Array:
            return jax.lax.slice_in_dim(a, start, start + count, axis=axis)

        results.append(function(material, jax.tree.map(part, particles)))
        start += count
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=axis), *results)


def particle_mass(scene: MPMScene, x: Array) -> Array:
    """Mass of each particle [kg], shape (num_particles,). ``x`` is any array with one entry per particle.

    Gradient: exact with respect to volume and densities.
    """
    density = per_material(scene, lambda m, a: jnp.broadcast_to(m.density, a.shape[:1]).astype(a.dtype), x)
    return jnp.broadcast_to(scene.particle_volume * density, x.shape[:1]).astype(x.dtype)


def least_particle_mass(scene: MPMScene, dtype: Any) -> Array:
    """Lower bound of the particles' masses [kg], shape (): least volume times least density. Gradient: none."""
    least = [jnp.min(jnp.asarray(m.density, dtype)) for m in materials_of(scene)]
    volume = jnp.min(jnp.asarray(scene.particle_volume, dtype))
    return jax.lax.stop_gradient(volume * functools.reduce(jnp.minimum, least))


@checked(
    scene=SCENE,
    state=STATE,
    bodies=optional(poses("num_bodies")),
    tolerance=optional(static(FINITE, "give a depth in metres")),
)
def check_placement(scene: MPMScene, state: MPMState, bodies: Pose | None = None, *, tolerance: float | None = None):
    """Checks that particles start inside the box, before the walls and outside the colliders.

    Args:
      scene: the scene.
      state: particles at the start.
      bodies: poses of the bodies that carry the colliders, (num_bodies, 3), (num_bodies, 3, 3); None: all at the origin
        with identity rotations.
      tolerance: allowed depth of particles inside a collider [m]; None: half the grid's spacing. (Contact acts on
        nodes, so touching bodies overlap by a fraction of a cell.)

    Raises:
      ValueError: particles lie outside the box, more than a cell behind a wall or inside a collider; the message names
        wall or collider and the depth. Not for use inside ``jit``.
    """
    check_state(scene, state)
    check_box(scene.grid, state.x)
    check_before_walls(scene.walls, scene.grid, state.x)
    if bodies is not None:
        check_bodies(scene.colliders, len(bodies.position))
    tolerance = 0.5 * scene.grid.spacing if tolerance is None else tolerance
    for i, collider in enumerate(scene.colliders):
        body = Pose(jnp.zeros(3), jnp.eye(3)) if bodies is None else body_pose(bodies, collider.body)
        pose = shape_pose(collider, body)
        local = jnp.matmul(state.x - pose.position, pose.rotation, precision="highest")
        depth = -np.asarray(signed_distance(collider.shape, local)[0])
        if (depth > tolerance).any():
            raise ValueError(
                f"{int(np.sum(depth > tolerance))} particles lie up to {depth.max():.3g} m inside collider {i} "
                f"({type(collider.shape).__name__}): move it or the particles apart, or allow a larger tolerance than "
                f"{tolerance:.3g} m"
            )


def has_invalid_parameters(scene: MPMScene, poses: Pose | None = None) -> Array:
    """Whether a scene holds a number that ``make_scene`` rejects, shape (), bool; for traced and replaced numbers.

    Args:
      scene: the scene.
      poses: poses of its bodies, of any shape; None: not checked.

    Gradient: none.
    """
    materials = materials_of(scene)
    numbers = part_numbers(materials, scene.particle_volume, scene.gravity, scene.colliders, scene.walls, poses)
    invalid = any_illegal(numbers)
    for material in materials:
        # The tolerance keeps a dt at the limit legal when the limit is rounded to float32.
        limit = (1.0 + 1e-5) * largest_stable_dt(material, scene.grid)
        invalid = invalid | ~jnp.all(scene.dt <= limit)
    return invalid


def check_state(scene: MPMScene, state: MPMState) -> None:
    """Raises ValueError unless the arrays of a state have the right shapes and the scene fits their number."""
    check_arrays(state)
    _check_count(scene, state.x.shape[0])


def _initial_memory(scene: MPMScene, x: Array) -> Array | None:
    """Initial history variables of the particles at x, as in ``MPMState.memory``."""
    most = max(len(m.initial_memory) for m in materials_of(scene))
    if not most:
        return None

    def one(material: Material, part: Array) -> Array:
        own = material.initial_memory
        return jnp.broadcast_to(jnp.asarray([*own, *[0.0] * (most - len(own))], x.dtype), (part.shape[0], most))

    return per_material(scene, one, x)


def _check_count(scene: MPMScene, num_particles: int) -> None:
    check_count(materials_of(scene), scene.particle_counts, scene.particle_volume, num_particles)
