"""Checks of the parts of a scene and of their consistency."""

from typing import Any

import numpy as np
from jax.core import Tracer

from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.contact_checks import collider_numbers
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.material_checks import check_material, material_numbers
from rewax.physics.mpm.materials import Material, parameters_of
from rewax.physics.mpm.walls import Walls, wall_numbers
from rewax.physics.numerics.checks import FINITE, GRAVITY, POSITIVE, Number, fits, shown, static_integer
from rewax.physics.numerics.pose import Pose
from rewax.types import Array

Counts = tuple[int, ...] | None
"""Number of particles of each of several materials; None with one material."""
VOLUME = "give the body's rest volume over its number of particles, in m^3"


def part_numbers(
    materials: tuple[Material, ...],
    particle_volume: Any,
    gravity: Any,
    colliders: tuple[Collider, ...],
    walls: Walls,
    poses: Pose | None = None,
) -> list[Number]:
    """All non-static numbers of a scene, with their legal values."""
    several = len(materials) > 1
    return [
        *(n for i, m in enumerate(materials) for n in material_numbers(m, f"material[{i}]." if several else "")),
        Number("particle_volume", particle_volume, POSITIVE, VOLUME),
        Number("gravity", gravity, FINITE, GRAVITY, (3,)),
        *collider_numbers(colliders, poses),
        *wall_numbers(walls),
    ]


def check_materials(material: Any, particle_counts: Any) -> tuple[Material, ...]:
    """The materials as a tuple. Raises ValueError for illegal materials and for counts that do not match them."""
    several = isinstance(material, (tuple, list))
    materials = tuple(material) if several else (material,)
    for i, one in enumerate(materials):
        check_material(one, f"material[{i}]." if len(materials) > 1 else "")
    counts = particle_counts if isinstance(particle_counts, (tuple, list)) else (0,)
    if (particle_counts is None) == several or len(counts) != len(materials):
        raise ValueError(
            f"particle_counts is {shown(particle_counts)} with {len(materials)} materials: give a tuple of materials "
            "and the number of particles of each, in their order; or one material and no particle_counts"
        )
    for i, count in enumerate(counts if several else ()):
        static_integer(f"particle_counts[{i}]", count, 1, f"give the number of particles of material[{i}], at least 1")
    return materials


def check_lengths(
    materials: tuple[Material, ...], counts: Counts, particle_volume: Any, num_particles: int | None = None
) -> None:
    """Raises ValueError for arrays per particle that differ in length from each other or from the counts.

    Args:
      materials: materials; their parameters are numbers, or arrays with one entry per particle.
      counts: number of particles of each material.
      particle_volume: a number, or an array with one entry per particle.
      num_particles: number of particles; None: not known.
    """
    total = num_particles if counts is None else sum(counts)
    total = _check_length("particle_volume", particle_volume, total)
    for i, material in enumerate(materials):
        length = total if counts is None else counts[i]
        prefix = "" if counts is None else f"material[{i}]."
        for p in parameters_of(material):
            length = _check_length(prefix + p.path, p.value, length, p.is_vector)
        total = length if counts is None else total


def check_count(materials: tuple[Material, ...], counts: Counts, particle_volume: Any, num_particles: int) -> None:
    """Raises ValueError unless the scene fits this number of particles."""
    if counts is not None and sum(counts) != num_particles:
        raise ValueError(
            f"particle_counts is {counts}, in sum {sum(counts)}, but there are {num_particles} particles: give the "
            "number of particles of each material"
        )
    check_lengths(materials, counts, particle_volume, num_particles)


def check_arrays(state: Any) -> None:
    """Raises ValueError unless the arrays of a state of particles have the shapes that ``MPMState`` says."""
    count = np.shape(state.x)[:1]
    for name, axes in (("x", (3,)), ("v", (3,)), ("C", (3, 3)), ("F", (3, 3)), ("memory", ("k",))):
        if name == "memory" and state.memory is None:
            continue
        shape = np.shape(getattr(state, name))
        if not fits(shape, (*count, *axes)):
            want = ", ".join(map(str, ("num_particles", *axes)))
            raise ValueError(f"state.{name} has shape {shape}: give shape ({want}) (map batches with jax.vmap)")


def check_box(grid: Grid, x: Array) -> None:
    """Raises ValueError for particles outside the box. Traced positions are not checked."""
    if isinstance(x, Tracer):
        return
    positions = np.asarray(x)
    lower, upper = np.asarray(grid.lower), np.asarray(grid.upper)
    slack = 1e-6 * grid.spacing * max(grid.shape)
    outside = ~((positions >= lower - slack) & (positions <= upper + slack)).all(axis=-1)
    if outside.any():
        first = int(np.argmax(outside))
        raise ValueError(
            f"{int(outside.sum())} particles lie outside the grid's box from {vector(lower)} to {vector(upper)} m; "
            f"the first is particle {first} at {vector(positions[first])}: move them, or give the grid another origin "
            "or more nodes"
        )


def vector(a: np.ndarray) -> str:
    return "(" + ", ".join(f"{float(c):.4g}" for c in a) + ")"


def _check_length(name: str, value: Any, length: int | None, vectors: bool = False) -> int | None:
    """The length of an array per particle. Raises ValueError if it differs from the given length."""
    shape = np.shape(value)
    per_particle = len(shape) == (2 if vectors else 1)
    wanted = "()" if not vectors else "(3,)"
    if (not per_particle and shape != ((3,) if vectors else ())) or (vectors and shape[-1] != 3) or 0 in shape:
        raise ValueError(f"{name} has shape {shape}: give shape {wanted}, or one entry for each particle")
    if per_particle and length not in (None, shape[0]):
        raise ValueError(
            f"{name} has {shape[0]} entries, but there are {length} particles: give shape {wanted}, or one entry for "
            "each particle"
        )
    return shape[0] if per_particle else length


__all__ = [
    "Counts",
    "check_arrays",
    "check_box",
    "check_count",
    "check_lengths",
    "check_materials",
    "part_numbers",
]
