"""Numbers of materials: names, ranges, zeros that are legal."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material
from plain_scenes import SAND, SOLID, WATER, scene

from rewax import struct
from rewax.physics.mpm import Hencky, Material, Newtonian, Snow, Tait, VonMises
from rewax.physics.mpm.laws import LameParameters
from rewax.physics.mpm.material_checks import check_laws, check_material, material_numbers

nan = float("nan")


def test_numbers_are_those_of_the_laws_that_are_there():
    muscle = flat_material(**SOLID, fibre=np.eye(3)[0], activation=1.0, viscosity=0.1)
    assert [n.name for n in material_numbers(muscle, "material[1].")] == [
        "material[1].density", "material[1].elasticity.youngs_modulus", "material[1].elasticity.poissons_ratio",
        "material[1].viscosity.viscosity", "material[1].muscle.fibre", "material[1].muscle.activation",
        "the squared length of material[1].muscle.fibre",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("material", "sentence"),
    [
        ({**SOLID, "youngs_modulus": -1.0}, "elasticity.youngs_modulus is -1.0, but must be positive: give Young's"),
        ({**SOLID, "youngs_modulus": "stiff"}, "elasticity.youngs_modulus is 'stiff', which is no real number: give"),
        ({**SAND, "cohesion": -0.1}, "plasticity.cohesion is -0.1"),
        ({**WATER, "speed_of_sound": nan}, "elasticity.speed_of_sound is nan, but must be positive and finite: give"),
        ({**SOLID, "viscosity": np.array([0.1, -1.0])}, "viscosity.viscosity[1] is -1.0, but must be 0 or more: give"),
        ({**SOLID, "fibre": [0, nan, 0], "activation": 1}, "muscle.fibre[1] is nan, but must be finite: give unit"),
        (
            {**SOLID, "fibre": [0, 2, 0], "activation": 1},
            "the squared length of muscle.fibre is 4.0, but must be above 0.9998 and below 1.0002",
        ),
        ({**SOLID, "fibre": np.eye(3) * [1, 1, 0], "activation": 1}, "the squared length of muscle.fibre[2] is 0.0"),
        (
            {**SOLID, "plasticity": Snow, "critical_compression": 1.0, "critical_stretch": 0.01, "hardening": 10.0},
            "plasticity.critical_compression is 1.0, but must be above 0 and below 1",
        ),
        ({**SOLID, "activation": None, "fibre": np.eye(3)[0]}, "muscle.activation is None, but must be finite: give"),
    ],
)
def test_impossible_numbers_are_refused(material, sentence):
    with pytest.raises(ValueError, match="^" + re.escape(sentence)):
        check_material(flat_material(**material))


def test_zero_is_a_cohesion_and_a_viscosity():
    """Zero in float32 too: compared with a limit just below zero it would count as negative."""
    for zero in (0.0, 0, np.float32(0.0), jnp.zeros(())):
        assert scene({**SAND, "cohesion": zero}).material.plasticity.cohesion == 0.0
        assert scene({**SOLID, "viscosity": zero}).material.viscosity.viscosity == 0.0


HENCKY = Hencky(youngs_modulus=1e4, poissons_ratio=0.3)
LAWS = {"elasticity": HENCKY, "viscosity": Newtonian(viscosity=0.1), "plasticity": VonMises(yield_stress=50.0)}


def own(field, **members):
    """The laws, one of them with other members of its class."""
    law = LAWS[field]
    return LAWS | {field: struct.dataclass(type("Mine", (type(law),), members))(**vars(law))}


def moduli(shear, first):
    return own("elasticity", moduli=lambda self: LameParameters(shear, first))


ILLEGAL = {
    "no shear": (moduli(nan, 1e4), "elasticity.moduli().shear is nan, but must be 0 or more and finite: return the"),
    "negative shear": (moduli(-1e4, 1e5), "elasticity.moduli().shear is -10000.0, but must be 0 or more: return the"),
    "nan": (moduli(1e4, nan), "elasticity.sound_speed(density) is nan, but must be positive and finite: let moduli()"),
    "no stiffness": (moduli(0.0, 0.0), "elasticity.sound_speed(density) is 0.0, but must be positive: let moduli()"),
    "a tuple": (
        own("elasticity", moduli=lambda self: (1.0, 2.0)),
        "elasticity.moduli() returned (1.0, 2.0): return LameParameters(shear=..., first=...)",
    ),
    "fluid": (
        {"elasticity": struct.dataclass(type("Mine", (Tait,), {"sound_speed": lambda *_: -5.0}))(speed_of_sound=5.0)},
        "elasticity.sound_speed(density) is -5.0, but must be positive: return the speed of pressure waves at rest",
    ),
    "negative viscosity": (
        own("viscosity", dynamic_viscosity=lambda self: -1e4),
        "viscosity.dynamic_viscosity() is -10000.0, but must be 0 or more: return an upper bound of the dynamic visc",
    ),
    "viscosity": (
        own("viscosity", dynamic_viscosity=lambda self: nan),
        "viscosity.dynamic_viscosity() is nan, but must be 0 or more and finite: return an upper bound of",
    ),
    "no largest stiffness": (
        own("plasticity", largest_stiffness=0.0),
        "plasticity.largest_stiffness is 0.0, but must be positive: give an upper bound of stiffness(memory)",
    ),
    "negative stiffness": (own("plasticity", largest_stiffness=-1.0), "plasticity.largest_stiffness is -1.0, but must"),
    "memory": (
        own("plasticity", initial_memory=(0.0, nan)),
        "plasticity.initial_memory[1] is nan, but must be finite: give an initial value",
    ),
    "a number as memory": (
        own("plasticity", initial_memory=0.0),
        "plasticity.initial_memory is 0.0: give a tuple of initial values, () for no history variables",
    ),
}


@pytest.mark.parametrize(("laws", "sentence"), ILLEGAL.values(), ids=ILLEGAL)
def test_what_a_law_of_the_user_returns_is_checked(laws, sentence):
    """With such values no dt would be above the largest stable one."""
    material = Material(density=1e3, **laws)
    with pytest.raises(ValueError, match="^" + re.escape(sentence)):
        scene(material)
    with pytest.raises(ValueError, match="^" + re.escape("material[1]." + sentence)):
        check_laws(material, "material[1].")


def test_laws_pass_with_arrays_and_traced_numbers_are_not_checked():
    def check(modulus):
        check_laws(
            Material(density=jnp.array([1e3, 2e3]), **LAWS | {"elasticity": HENCKY.replace(youngs_modulus=modulus)})
        )
        return modulus

    check(1e4)
    jax.jit(jax.vmap(check))(jnp.array([-1.0, 1.0]))
