"""Strains, energies and forces of triangles, hinges, segments and bends, by components.

Every element has strains s(x) with an energy psi(s). Its forces are -(ds/dx)^T (dpsi/ds + viscous stress), so they sum
to zero, and so do their torques.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewax.lowering.kernels import joined, pointwise, separated
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin.materials import Cloth, MembraneLaw, Rope
from rewax.types import Array, Scalar

Corners = tuple[Vec3, ...]
Strain = tuple[Array, Array, Array]
Inverse = tuple[Array, Array, Array, Array]


# --- Strains ----------------------------------------------------------------------------------------------------------


def green_strain(x: Corners, inverse: Inverse) -> Strain:
    """Green strain of triangles [-]: (E_11, E_22, 2 E_12) along warp and weft.

    Args:
      x: corners.
      inverse: inverse of the edge matrix at rest in the plane [1/m], row by row.
    """
    first, second = cp.subtract(x[1], x[0]), cp.subtract(x[2], x[0])
    a, b, c, d = inverse
    warp = cp.vector(lambda i: first[i] * a + second[i] * c)
    weft = cp.vector(lambda i: first[i] * b + second[i] * d)
    return 0.5 * (cp.dot(warp, warp) - 1.0), 0.5 * (cp.dot(weft, weft) - 1.0), cp.dot(warp, weft)


def hinge_angle(x: Corners) -> Array:
    """Angle between the normals of the two triangles at an edge [rad], in (-pi, pi]; zero where flat."""
    edge = cp.subtract(x[1], x[0])
    left = cp.cross(edge, cp.subtract(x[2], x[0]))
    right = cp.cross(cp.subtract(x[3], x[0]), edge)
    sine = cp.dot(cp.cross(left, right), edge) * jax.lax.rsqrt(cp.dot(edge, edge))
    return jnp.arctan2(sine, cp.dot(left, right))


def segment_strain(x: Corners, length: Array) -> Array:
    """Length over length at rest, minus 1 [-]."""
    edge = cp.subtract(x[1], x[0])
    return jnp.sqrt(cp.dot(edge, edge)) / length - 1.0


def half_square_curvature(x: Corners) -> Array:
    """|kb|^2 / 2 [-] with the curvature binormal kb = 2 a x b / (|a||b| + a . b), of length 2 tan(angle / 2).

    Source: Bergou et al. 2008, "Discrete elastic rods", eq. 1. Gradient: exact, finite for straight ropes.
    """
    a, b = cp.subtract(x[1], x[0]), cp.subtract(x[2], x[1])
    product = cp.cross(a, b)
    denominator = jnp.sqrt(cp.dot(a, a) * cp.dot(b, b)) + cp.dot(a, b)
    return 2.0 * cp.dot(product, product) / (denominator * denominator)


# --- The membrane's law -----------------------------------------------------------------------------------------------


def membrane_energy(strain: Strain, cloth: Cloth, law: MembraneLaw) -> Array:
    """Energy per rest area [J/m^2]."""
    e11, e22, e12 = strain
    if law is MembraneLaw.SAINT_VENANT_KIRCHHOFF:
        return 0.5 * (cloth.warp * e11 * e11 + cloth.weft * e22 * e22 + cloth.shear * e12 * e12) + (
            cloth.coupling * e11 * e22
        )
    log_ratio = 0.5 * jnp.log(square_area_ratio(strain))
    return cloth.shear * (e11 + e22 - log_ratio) + 0.5 * cloth.coupling * log_ratio * log_ratio


def membrane_stress(strain: Strain, cloth: Cloth, law: MembraneLaw) -> Strain:
    """Derivative of ``membrane_energy`` with respect to the strain [N/m]: second Piola-Kirchhoff stress."""
    e11, e22, e12 = strain
    if law is MembraneLaw.SAINT_VENANT_KIRCHHOFF:
        return (
            cloth.warp * e11 + cloth.coupling * e22,
            cloth.weft * e22 + cloth.coupling * e11,
            cloth.shear * e12,
        )
    square = square_area_ratio(strain)
    pressure = (0.5 * cloth.coupling * jnp.log(square) - cloth.shear) / square
    return (
        cloth.shear + pressure * (1.0 + 2.0 * e22),
        cloth.shear + pressure * (1.0 + 2.0 * e11),
        -pressure * e12,
    )


def square_area_ratio(strain: Strain) -> Array:
    """det C [-], the square of area over area at rest."""
    e11, e22, e12 = strain
    return (1.0 + 2.0 * e11) * (1.0 + 2.0 * e22) - e12 * e12


# --- Forces -----------------------------------------------------------------------------------------------------------


def membrane_force(cloth: Cloth, law: MembraneLaw, x: Corners, v: Corners, inverse: Inverse, area: Array) -> Corners:
    """Forces of the membrane on the corners of triangles [N]. Gradient: exact."""
    shared, own = separated(cloth.replace(bending=None, bending_ratio=None, yield_curvature=None))
    return _membrane(law)(shared, (own, x, v, inverse, area))


@functools.cache
def _membrane(law: MembraneLaw) -> Callable[[Any, Any], Corners]:
    @pointwise
    def membrane(shared: Cloth, given: tuple[Cloth, Corners, Corners, Inverse, Array]) -> Corners:
        own, x, v, inverse, area = given
        cloth = joined(shared, own)
        strain, rate, pull = _linearized(lambda x: green_strain(x, inverse), x, v)
        elastic = membrane_stress(strain, cloth, law)
        viscous = membrane_stress(rate, cloth, MembraneLaw.SAINT_VENANT_KIRCHHOFF)
        return pull(cp.vector(lambda i: -area * (elastic[i] + cloth.damping * viscous[i])))

    return membrane


def hinge_force(stiffness: Scalar, damping: Scalar, x: Corners, v: Corners, angle: Array, weight: Array) -> Corners:
    """Forces of bending on the corners of hinges [N]: energy stiffness weight (theta - angle)^2 / 2. Gradient: exact.

    Source: Grinspun et al. 2003, "Discrete shells", with weight |e|^2 / (A_1 + A_2): for it ``stiffness`` is the
      flexural rigidity of cylinders along the lines of a rectangular sheet.
    """
    shared, own = separated((stiffness, damping))
    return _hinge(shared, (own, x, v, angle, weight))


@pointwise
def _hinge(shared: Any, given: tuple[Any, Corners, Corners, Array, Array]) -> Corners:
    own, x, v, angle, weight = given
    stiffness, damping = joined(shared, own)
    theta, rate, pull = _linearized(hinge_angle, x, v)
    return pull(-stiffness * weight * (theta - angle + damping * rate))


def hinge_turn(damping: Scalar, x: Corners, v: Corners, angle: Array) -> Array:
    """Angle of hinges minus that at rest, plus damping times its rate [rad]. Gradient: exact."""
    return _hinge_turn((damping,), (x, v, angle))


@pointwise
def _hinge_turn(shared: Any, given: tuple[Corners, Corners, Array]) -> Array:
    x, v, angle = given
    theta, rate = jax.jvp(hinge_angle, (x,), (v,))
    return theta - angle + shared[0] * rate


def hinge_pull(x: Corners, moment: Array) -> Corners:
    """Forces of moments [N m] on the corners of hinges [N]: -moment dtheta/dx. Gradient: exact."""
    return _hinge_pull((), (x, moment))


@pointwise
def _hinge_pull(shared: Any, given: tuple[Corners, Array]) -> Corners:
    del shared
    x, moment = given
    return jax.vjp(hinge_angle, x)[1](-moment)[0]


def segment_force(rope: Rope, x: Corners, v: Corners, length: Array) -> Corners:
    """Forces of stretch on the ends of segments [N]. Gradient: exact."""
    shared, own = separated((rope.stretch, rope.damping))
    return _segment(shared, (own, x, v, length))


@pointwise
def _segment(shared: Any, given: tuple[Any, Corners, Corners, Array]) -> Corners:
    own, x, v, length = given
    stretch, damping = joined(shared, own)
    strain, rate, pull = _linearized(lambda x: segment_strain(x, length), x, v)
    return pull(-length * stretch * (strain + damping * rate))


def bend_force(bending: Scalar, x: Corners, length: Array) -> Corners:
    """Forces of bending on three consecutive vertices [N]: energy bending |kb|^2 / (2 length). Gradient: exact."""
    shared, own = separated((bending,))
    return _bend(shared, (own, x, length))


@pointwise
def _bend(shared: Any, given: tuple[Any, Corners, Array]) -> Corners:
    own, x, length = given
    (bending,) = joined(shared, own)
    _, pull = jax.vjp(half_square_curvature, x)
    return pull(-bending / length + jnp.zeros_like(length))[0]


def _linearized(strain: Callable[[Corners], Any], x: Corners, v: Corners) -> tuple[Any, Any, Callable[[Any], Corners]]:
    """Strains, their rates, and the map from stresses to forces."""
    value, rate = jax.jvp(strain, (x,), (v,))
    _, pull = jax.vjp(strain, x)
    return value, rate, lambda stress: pull(stress)[0]


__all__ = [
    "bend_force", "green_strain", "half_square_curvature", "hinge_angle", "hinge_force", "hinge_pull",
    "hinge_turn", "membrane_energy",
    "membrane_force", "membrane_stress", "segment_force", "segment_strain", "square_area_ratio",
]  # fmt: skip
