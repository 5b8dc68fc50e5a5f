"""Checks of the parameters of a material."""

from rewax.physics.mpm.laws import Fluid, LameParameters
from rewax.physics.mpm.materials import Material, sound_speed
from rewax.physics.numerics.checks import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    Number,
    check_number,
    check_numbers,
    numbers_of,
    shown,
)
from rewax.physics.numerics.fields import instance, items, real

MATERIAL = instance(Material, "give a Material(density=..., elasticity=...)")
_MEMORY = items(real(FINITE, "give an initial value"), "give a tuple of initial values, () for no history variables")


def material_numbers(material: Material, prefix: str = "") -> list[Number]:
    """The parameters of a material and of its laws, with their legal values.

    Args:
      material: the material.
      prefix: text before the parameters' names in messages.
    """
    laws = material.laws.items()
    return [*numbers_of(material, prefix), *(n for name, law in laws for n in law.numbers(f"{prefix}{name}."))]


def check_material(material: Material, prefix: str = "") -> None:
    """Raises ValueError for illegal parameters. The message names field, value and remedy."""
    MATERIAL(prefix.removesuffix(".") or "material", material)
    check_numbers(material_numbers(material, prefix))


def check_laws(material: Material, prefix: str = "") -> None:
    """Raises ValueError for what a law's methods return or its class declares, if no stable substep follows from it.

    Traced values are not checked.

    Args:
      material: the material, after ``check_material``.
      prefix: text before the laws' names in messages.
    """
    elasticity, plasticity, viscosity = material.elasticity, material.plasticity, material.viscosity
    remedy = "return the speed of pressure waves at rest in m/s"
    if not isinstance(elasticity, Fluid):
        moduli = elasticity.moduli()
        if not isinstance(moduli, LameParameters):
            raise ValueError(
                f"{prefix}elasticity.moduli() returned {shown(moduli)}: return LameParameters(shear=..., first=...)"
            )
        shear = f"{prefix}elasticity.moduli().shear"
        check_number(shear, moduli.shear, NOT_NEGATIVE, "return the shear modulus at small strains in Pa")
        remedy = "let moduli() return Lame parameters in Pa with first + 2 shear above 0"
    check_number(f"{prefix}elasticity.sound_speed(density)", sound_speed(material), POSITIVE, remedy)
    if plasticity is not None:
        remedy = "give an upper bound of stiffness(memory)"
        check_number(f"{prefix}plasticity.largest_stiffness", plasticity.largest_stiffness, POSITIVE, remedy)
        _MEMORY(f"{prefix}plasticity.initial_memory", plasticity.initial_memory)
    if viscosity is not None:
        remedy = "return an upper bound of the dynamic viscosity in Pa s"
        check_number(f"{prefix}viscosity.dynamic_viscosity()", viscosity.dynamic_viscosity(), NOT_NEGATIVE, remedy)


__all__ = ["MATERIAL", "check_laws", "check_material", "material_numbers"]
