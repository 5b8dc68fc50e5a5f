"""Checks of the parameters of a material."""

from rewax.physics.mpm.materials import Material
from rewax.physics.numerics.checks import Number, check_numbers, numbers_of
from rewax.physics.numerics.fields import instance

MATERIAL = instance(Material, "give a Material(density=..., elasticity=...)")


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


__all__ = ["MATERIAL", "check_material", "material_numbers"]
