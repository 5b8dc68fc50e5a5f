"""Elastic constants, converted into each other."""

from typing import NamedTuple

from rewax.types import Scalar


class LameParameters(NamedTuple):
    shear: Scalar
    """Shear modulus mu [Pa]."""
    first: Scalar
    """First Lame parameter lambda [Pa]."""


def lame_parameters(youngs_modulus: Scalar, poissons_ratio: Scalar) -> LameParameters:
    """mu = E / (2 (1 + nu)), lambda = E nu / ((1 + nu) (1 - 2 nu)) [Pa]. Gradient: exact."""
    E, nu = youngs_modulus, poissons_ratio
    return LameParameters(E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)))
