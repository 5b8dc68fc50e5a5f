"""Parameters of materials: those that no law uses, and zeros that are legal."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain_scenes import SAND, SOLID, WATER, scene

from rewax.physics.mpm import Plasticity


@pytest.mark.parametrize(
    ("material", "sentence"),
    [
        ({**SOLID, "yield_stress": 300.0}, "yield_stress is 300.0, but no law uses it, as plasticity is Plasticity.NONE:"
         " leave it out, or give Plasticity.VON_MISES"),
        ({**SAND, "yield_stress": 300.0}, "yield_stress is 300.0, but no law uses it, as plasticity is Plasticity.DRUC"),
        ({**SOLID, "friction_angle": 0.5}, "friction_angle is 0.5, but no law uses it, as plasticity is Plasticity.NONE"),
        ({**SOLID, "cohesion": 0.0}, "cohesion is 0.0, but no law uses it, as plasticity is Plasticity.NONE"),
        ({**SOLID, "hardening": 10.0}, "hardening is 10.0, but no law uses it, as plasticity is Plasticity.NONE"),
        ({**SOLID, "speed_of_sound": 5.0}, "speed_of_sound is 5.0, but no law uses it, as elasticity is Elasticity.HEN"),
        ({**WATER, "youngs_modulus": 1e4}, "youngs_modulus is 10000.0, but no law uses it, as elasticity is Elasticity"),
        ({**WATER, "poissons_ratio": 0.3}, "poissons_ratio is 0.3, but no law uses it, as elasticity is Elasticity.TAI"),
        ({**SOLID, "activation": 50.0}, "activation is 50.0, but no law uses it, as fibre is None: leave it out, or give"),
        ({**SOLID, "fibre": np.eye(3)[0]}, "fibre is [1. 0. 0.], but no law uses it, as activation is None: leave it ou"),
        ({**WATER, "plasticity": Plasticity.VON_MISES, "yield_stress": 1.0}, "plasticity is Plasticity.VON_MISES with "
         "Elasticity.TAIT, a fluid, which has no yield surface: give Plasticity.NONE"),
    ],
)  # fmt: skip
def test_parameters_that_no_law_uses_are_refused(material, sentence):
    with pytest.raises(ValueError, match="^" + re.escape(sentence)):
        scene(material)


def test_a_traced_parameter_that_no_law_uses_is_refused():
    with pytest.raises(
        ValueError, match=r"yield_stress is traced, but no law uses it, as plasticity is Plasticity\.NONE"
    ):
        jax.jit(lambda y: scene({**SOLID, "yield_stress": y}).gravity)(300.0)


def test_zero_is_a_cohesion_and_a_viscosity():
    """Zero in float32 too: compared with a limit just below zero it would count as negative."""
    for zero in (0.0, 0, np.float32(0.0), jnp.zeros(())):
        assert scene({**SAND, "cohesion": zero}).material.cohesion is zero
        assert scene({**SOLID, "viscosity": zero}).material.viscosity is zero
