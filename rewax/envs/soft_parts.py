"""Pieces of the scenes of soft tasks: dough, particles that fill a box, walls."""

import jax.numpy as jnp
import numpy as np

from rewax.physics.mpm import Elasticity, Material, Plasticity, Wall, WallKind, Walls
from rewax.types import Array


def dough(youngs_modulus: float, yield_stress: float) -> Material:
    """Plasticine of density 1: Hencky's law with a von Mises yield stress [Pa], Poisson's ratio 0.2."""
    return Material(
        youngs_modulus=jnp.asarray(youngs_modulus),
        poissons_ratio=jnp.asarray(0.2),
        density=jnp.asarray(1.0),
        yield_stress=jnp.asarray(yield_stress),
        elasticity=Elasticity.HENCKY,
        plasticity=Plasticity.VON_MISES,
    )


def random_box(center: tuple[float, ...], size: tuple[float, ...], num_particles: int) -> Array:
    """Uniform points of a box from a fixed seed, the same in every environment, shape (num_particles, 3)."""
    points = np.random.Generator(np.random.PCG64(0)).random((num_particles, 3))
    return jnp.asarray((points - 0.5) * np.asarray(size) + np.asarray(center), dtype=jnp.result_type(float))


def box_walls(
    floor: float,
    lower: tuple[float, float],
    upper: tuple[float, float],
    *,
    ceiling: float | None = None,
    floor_kind: WallKind = WallKind.GRIPPING,
) -> Walls:
    """A floor (by default one that holds what presses on it), frictionless sides at (x, z) = lower and upper, and a
    ceiling or none.
    """
    return Walls(
        lower=(Wall(position=lower[0]), Wall(position=floor, kind=floor_kind), Wall(position=lower[1])),
        upper=(Wall(position=upper[0]), None if ceiling is None else Wall(position=ceiling), Wall(position=upper[1])),
    )
