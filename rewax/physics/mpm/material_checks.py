"""What the parameters of a material may be, and which of them its laws use."""

import dataclasses
import math
from typing import Any

import numpy as np
from jax.core import Tracer

from rewax.physics.mpm.laws import FLUIDS, Elasticity, Plasticity
from rewax.physics.mpm.materials import Material
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE, Legal, Number, check_numbers

_FRESH_SNOW = "give a positive number (fresh snow: critical_compression 0.025, critical_stretch 0.0075, hardening 10)"
_PLASTIC = {
    Plasticity.NONE: (),
    Plasticity.VON_MISES: ("yield_stress",),
    Plasticity.DRUCKER_PRAGER: ("friction_angle", "cohesion"),
    Plasticity.SNOW: ("critical_compression", "critical_stretch", "hardening"),
}
"""Parameters of each plasticity."""
_ELASTIC = ("youngs_modulus", "poissons_ratio")
"""Parameters of every elasticity but ``TAIT``."""


def material_numbers(material: Material, prefix: str = "") -> list[Number]:
    """The parameters that the material's laws use, and what they may be.

    Args:
      material: the material.
      prefix: what messages write before the names of its parameters.
    """
    numbers = [*_elastic_numbers(material), *_plastic_numbers(material), *_stress_numbers(material)]
    return [number._replace(name=prefix + number.name) for number in numbers]


def check_material(material: Material, prefix: str = "") -> None:
    """Raises ValueError for parameters that no material can have, or that no law of this one uses.

    The message names field, value and remedy.
    """
    if not isinstance(material, Material):
        raise ValueError(f"{prefix or 'material'} is {material!r}: give a Material(density=..., ...)")
    if material.elasticity in FLUIDS and material.plasticity is not Plasticity.NONE:
        raise ValueError(
            f"{prefix}plasticity is {material.plasticity} with {material.elasticity}, a fluid, which has no yield "
            "surface: give Plasticity.NONE or the elasticity of a solid"
        )
    _check_unused(material, prefix)
    check_numbers(material_numbers(material, prefix))


def _elastic_numbers(material: Material) -> list[Number]:
    density = Number("density", material.density, POSITIVE, "give the rest density in kg/m^3")
    if material.elasticity is Elasticity.TAIT:
        speed = material.speed_of_sound
        return [density, Number("speed_of_sound", speed, POSITIVE, "give the fluid's speed of sound in m/s")]
    fluid = material.elasticity is Elasticity.FLUID
    ratio, remedy = Legal(-1.0, 0.5), "take 0.45 for rubber (0.5 is incompressible)"
    if fluid:
        ratio, remedy = Legal(0.0, 0.5), "take 0.3, say (at 0 the fluid has no pressure)"
    return [
        density,
        Number("youngs_modulus", material.youngs_modulus, POSITIVE, "give Young's modulus in Pa"),
        Number("poissons_ratio", material.poissons_ratio, ratio, remedy),
    ]


def _plastic_numbers(material: Material) -> list[Number]:
    if material.plasticity is Plasticity.VON_MISES:
        return [Number("yield_stress", material.yield_stress, POSITIVE, "give the von Mises yield stress in Pa")]
    if material.plasticity is Plasticity.DRUCKER_PRAGER:
        cohesion = 0.0 if material.cohesion is None else material.cohesion
        angle = "give an angle in radians (dry sand: 0.5)"
        return [
            Number("friction_angle", material.friction_angle, Legal(0.0, 0.5 * math.pi), angle),
            Number("cohesion", cohesion, NOT_NEGATIVE, "give the strain to which it can be pulled"),
        ]
    return [Number(name, getattr(material, name), POSITIVE, _FRESH_SNOW) for name in _PLASTIC[material.plasticity]]


def _stress_numbers(material: Material) -> list[Number]:
    """Parameters of viscous and active stress."""
    numbers = []
    if material.viscosity is not None:
        numbers.append(Number("viscosity", material.viscosity, NOT_NEGATIVE, "give the dynamic viscosity in Pa s"))
    if material.fibre is not None:
        numbers.append(Number("fibre", material.fibre, FINITE, "give unit vectors along the fibres"))
    if material.activation is not None:
        numbers.append(Number("activation", material.activation, FINITE, "give an active stress in Pa"))
    return numbers


def _check_unused(material: Material, prefix: str) -> None:
    for plasticity, names in _PLASTIC.items():
        if material.plasticity is not plasticity:
            _refuse(material, prefix, names, f"plasticity is {material.plasticity}", f"give {plasticity}")
    fluid = material.elasticity is Elasticity.TAIT
    if fluid:
        _refuse(material, prefix, _ELASTIC, "elasticity is Elasticity.TAIT", "give another elasticity")
    else:
        why = f"elasticity is {material.elasticity}"
        _refuse(material, prefix, ("speed_of_sound",), why, "give Elasticity.TAIT")
    for name, other in (("fibre", "activation"), ("activation", "fibre")):
        if getattr(material, other) is None:
            _refuse(material, prefix, (name,), f"{other} is None", f"give {other} too")


def _refuse(material: Material, prefix: str, names: tuple[str, ...], why: str, remedy: str) -> None:
    defaults = {field.name: field.default for field in dataclasses.fields(material)}
    for name in names:
        value = getattr(material, name)
        if not _is_default(value, defaults[name]):
            shown = "traced" if isinstance(value, Tracer) else value
            raise ValueError(f"{prefix}{name} is {shown}, but no law uses it, as {why}: leave it out, or {remedy}")


def _is_default(value: Any, default: Any) -> bool:
    if value is None or default is None:
        return value is default
    return not isinstance(value, Tracer) and np.ndim(value) == 0 and bool(np.asarray(value) == default)


__all__ = ["check_material", "material_numbers"]
