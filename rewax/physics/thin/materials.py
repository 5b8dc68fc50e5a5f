"""Materials of cloth and ropes, per area and per length."""

import enum

from rewax import struct
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE, Legal
from rewax.physics.numerics.fields import checked, real
from rewax.types import Scalar


class MembraneLaw(enum.Enum):
    """Elastic law of the membrane."""

    SAINT_VENANT_KIRCHHOFF = "Saint Venant-Kirchhoff"
    """Stress is linear in the Green strain; warp and weft may differ."""
    NEO_HOOKEAN = "neo-Hookean"
    """Isotropic and compressible: mu/2 (tr C - 2) - mu log J + lam/2 (log J)^2 with mu = ``shear``, lam = ``coupling``;
    ``warp`` and ``weft`` must be coupling + 2 shear."""


class BendingLaw(enum.Enum):
    """Energy of bending of cloth."""

    PLATE = "plate"
    """An isotropic thin plate: its deflections converge under refinement on every mesh, see ``thin/plate.py``."""
    HINGES = "hinges"
    """One spring per edge (Grinspun et al. 2003): cheaper, but its stiffness depends on the mesh, and Poisson's ratio
    has no effect."""


@struct.dataclass
class Cloth(struct.Replaceable):
    """A shell's material. Parameters are numbers, or arrays (num_triangles,), of ``bending`` (num_hinges,) for
    ``BendingLaw.HINGES``.

    Attributes:
      warp, weft: membrane stiffness along the first and second axis [N/m].
      coupling: stress along one axis per strain along the other [N/m].
      shear: shear stiffness [N/m].
      bending: flexural rigidity [N m].
      bending_ratio: Poisson's ratio of bending [-], in (-1, 1): moment along one axis per curvature along the other.
      density: mass per area [kg/m^2]. ``make_scene`` makes ``scene.mass`` of it; steps read the masses alone.
      damping: Kelvin-Voigt time [s]: stress of strain rates is damping times the stiffness. Hinges take the largest.
      yield_curvature: curvature beyond which bending leaves a crease [1/m], also as an array (num_hinges,); None: it
        never does. A hinge yields at this curvature times its width, see ``creases.yield_angle``.
    """

    warp: Scalar = struct.number(POSITIVE, "give a stiffness in N/m, Young's modulus times thickness")
    weft: Scalar = struct.number(POSITIVE, "give a stiffness in N/m, Young's modulus times thickness")
    coupling: Scalar = struct.number(FINITE, "give a stiffness in N/m, 0 without Poisson effect", default=0.0)
    shear: Scalar = struct.number(POSITIVE, "give a stiffness in N/m, shear modulus times thickness")
    bending: Scalar = struct.number(NOT_NEGATIVE, "give a flexural rigidity in N m, 0 for none", default=0.0)
    bending_ratio: Scalar = struct.number(Legal(-1.0, 1.0), "take 0.3, 0 for none", default=0.0)
    density: Scalar = struct.number(POSITIVE, "give a mass per area in kg/m^2")
    damping: Scalar = struct.number(NOT_NEGATIVE, "give a time in s, 0 for none", default=0.0)
    yield_curvature: Scalar | None = struct.number(
        POSITIVE, "give a curvature in 1/m, or None for cloth that stays elastic", default=None
    )


@struct.dataclass
class Rope(struct.Replaceable):
    """A rope's material, straight at rest and free of twist. Parameters are numbers, or arrays (num_segments,), of
    ``bending`` (num_bends,).

    Attributes:
      stretch: force per strain [N], Young's modulus times the area of the section.
      bending: flexural rigidity [N m^2].
      density: mass per length [kg/m]. ``make_scene`` makes ``scene.mass`` of it; steps read the masses alone.
      damping: Kelvin-Voigt time of stretch [s]; bending is not damped.
    """

    stretch: Scalar = struct.number(POSITIVE, "give a force per strain in N")
    bending: Scalar = struct.number(NOT_NEGATIVE, "give a flexural rigidity in N m^2, 0 for none", default=0.0)
    density: Scalar = struct.number(POSITIVE, "give a mass per length in kg/m")
    damping: Scalar = struct.number(NOT_NEGATIVE, "give a time in s, 0 for none", default=0.0)


@checked(
    youngs_modulus=real(POSITIVE, "give Young's modulus in Pa"),
    poissons_ratio=real(Legal(-1.0, 0.5), "take 0.3"),
    thickness=real(POSITIVE, "give a thickness in metres"),
    density=real(POSITIVE, "give a density in kg/m^3"),
)
def isotropic_cloth(
    *, youngs_modulus: Scalar, poissons_ratio: Scalar, thickness: Scalar, density: Scalar, damping: Scalar = 0.0
) -> Cloth:
    """The material of a thin plate in plane stress, at small strains.

    Args:
      youngs_modulus: E [Pa], > 0.
      poissons_ratio: nu [-], in (-1, 0.5).
      thickness: h [m], > 0.
      density: [kg/m^3], > 0.
      damping: Kelvin-Voigt time [s], >= 0.

    Returns:
      warp = weft = E h / (1 - nu^2), coupling = nu warp, shear = E h / (2 (1 + nu)), bending = E h^3 / (12 (1 - nu^2)),
      bending_ratio = nu. They are legal for both laws. Gradient: exact.

    Raises:
      ValueError: an illegal number, except ``damping``, which ``make_scene`` checks.
    """
    warp = youngs_modulus * thickness / (1.0 - poissons_ratio**2)
    return Cloth(
        warp=warp,
        weft=warp,
        coupling=poissons_ratio * warp,
        shear=0.5 * (1.0 - poissons_ratio) * warp,
        bending=warp * thickness**2 / 12.0,
        bending_ratio=poissons_ratio,
        density=density * thickness,
        damping=damping,
    )


__all__ = ["BendingLaw", "Cloth", "MembraneLaw", "Rope", "isotropic_cloth"]
