"""Parts of the scenes of soft tasks: dough, water, particles that fill a box, walls."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from rewax.envs.kit.options import number_option
from rewax.physics.mpm import Hencky, Material, QuadraticFluid, VonMises, Wall, WallKind, Walls
from rewax.types import Array

_IN_PA = "give a number of pascals"


def dough(youngs_modulus: float, yield_stress: float, *, poissons_ratio: float = 0.2, density: float = 1.0) -> Material:
    """Plasticine: Hencky's elasticity with the return map ``VonMises``.

    Args:
      youngs_modulus: E [Pa], > 0.
      yield_stress: norm of the stress deviator at yield [Pa], > 0, see ``mpm.VonMises``.
      poissons_ratio: nu [-], in (-1, 0.5).
      density: [kg/m^3]; 1 is that of Rewarped's tasks.

    Raises:
      ValueError: Young's modulus or the yield stress is no positive number.
    """
    number_option("youngs_modulus", youngs_modulus, remedy=_IN_PA)
    number_option("yield_stress", yield_stress, remedy=_IN_PA)
    return Material(
        density=density,
        elasticity=Hencky(youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio),
        plasticity=VonMises(yield_stress=yield_stress),
    )


def water(youngs_modulus: float) -> Material:
    """Rewarped's water. Its bulk modulus is lambda of this Young's modulus [Pa] and Poisson's ratio 0.3.

    Raises:
      ValueError: the modulus is no positive number.
    """
    number_option("youngs_modulus", youngs_modulus, remedy=_IN_PA)
    return Material(density=1000.0, elasticity=QuadraticFluid(youngs_modulus=youngs_modulus, poissons_ratio=0.3))


def turn_about_y(angle: Array) -> Array:
    """Matrices of rotations about y, (n,) [rad] -> (n, 3, 3). Gradient: exact."""
    zero, one, c, s = jnp.zeros_like(angle), jnp.ones_like(angle), jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=-1).reshape(-1, 3, 3)


def random_box(center: tuple[float, ...], size: tuple[float, ...], num_particles: int) -> Array:
    """Uniform random points of a box, shape (num_particles, 3). The seed is fixed: all environments have the same."""
    points = np.random.Generator(np.random.PCG64(0)).random((num_particles, 3))
    return jnp.asarray((points - 0.5) * np.asarray(size) + np.asarray(center), dtype=jnp.result_type(float))


def lattice_box(
    center: Sequence[float] | np.ndarray, size: Sequence[float] | np.ndarray, counts: tuple[int, ...]
) -> Array:
    """A lattice of points in a box: centers of ``counts`` equal cells along each axis, shape (prod(counts), 3).

    Rows along the last axis follow one another. Each begins at another place and comes back to it, and so do layers. So
    every n-th point, which a ``PointCloud`` observes, comes from all of the box, even if n is the length of a row.
    """
    layers, rows, length = counts
    z = _cycles(layers * rows, length)
    y = np.broadcast_to(_cycles(layers, rows).reshape(-1, 1), z.shape)
    x = np.broadcast_to(np.repeat(np.arange(layers), rows)[:, None], z.shape)
    cells = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    points = ((cells + 0.5) / np.asarray(counts) - 0.5) * np.asarray(size) + np.asarray(center)
    return jnp.asarray(points, jnp.result_type(float))


def _cycles(number: int, length: int) -> np.ndarray:
    """0 to ``length`` - 1 in cyclic order from starts that fill the range evenly, shape (number, length)."""
    golden = (5**0.5 - 1) / 2  # multiples of it, without their whole part, fill the unit interval evenly
    starts = (np.arange(number) * golden % 1.0 * length).astype(int)
    return (starts[:, None] + np.arange(length)) % length


def box_walls(
    floor: float,
    lower: tuple[float, float],
    upper: tuple[float, float],
    *,
    ceiling: float | None = None,
    floor_kind: WallKind = WallKind.GRIPPING,
    floor_friction: float | None = None,
) -> Walls:
    """Walls of a box: a floor, frictionless sides and perhaps a ceiling.

    Args:
      floor: height of the floor [m].
      lower, upper: x and z of the sides [m].
      ceiling: height of the ceiling [m], or None for none.
      floor_kind: by default particles on the floor do not move along it.
      floor_friction: Coulomb coefficient of a floor of ``WallKind.SEPARATING`` [-]; None: none. With another kind
        ``make_scene`` refuses it.
    """
    bottom = Wall(position=floor, kind=floor_kind, friction=floor_friction)
    return Walls(
        lower=(Wall(position=lower[0]), bottom, Wall(position=lower[1])),
        upper=(Wall(position=upper[0]), None if ceiling is None else Wall(position=ceiling), Wall(position=upper[1])),
    )
