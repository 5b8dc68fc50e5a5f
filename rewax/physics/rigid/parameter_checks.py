"""Legal values of a rigid model's parameters."""

from collections.abc import Mapping
from typing import Any

from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, Number, any_illegal
from rewax.physics.rigid.spring_contacts import Penalty, penalty_numbers
from rewax.types import Array

_NOT_NEGATIVE = {
    "body_mass", "body_inertia", "dof_armature", "dof_damping", "dof_frictionloss", "geom_friction", "geom_size",
    "jnt_stiffness", "pair_friction",
}  # fmt: skip


def parameter_numbers(parameters: Mapping[str, Any]) -> list[Number]:
    """Parameters by the names of MuJoCo's fields, with their legal values."""
    return [
        Number(name, value, NOT_NEGATIVE if name in _NOT_NEGATIVE else FINITE, "give it in MuJoCo's unit")
        for name, value in parameters.items()
    ]


def has_invalid_parameters(parameters: Mapping[str, Any], gravity: Array, penalty: Penalty | None) -> Array:
    """Whether a model holds an illegal value, shape (), bool; for traced or replaced values. Gradient: none."""
    numbers = [*parameter_numbers(parameters), Number("gravity", gravity, FINITE, "give an acceleration in m/s^2")]
    return any_illegal(numbers + ([] if penalty is None else penalty_numbers(penalty)))


__all__ = ["has_invalid_parameters", "parameter_numbers"]
