"""Numbers of materials: names, ranges, zeros that are legal."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material
from plain_scenes import SAND, SOLID, WATER, scene

from rewax.physics.mpm import Snow
from rewax.physics.mpm.material_checks import check_material, material_numbers

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
