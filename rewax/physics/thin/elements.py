"""Strains, energies and forces of triangles, hinges, segments and bends, by components.

Every element has strains s(x) with an energy psi(s). Its forces are -(ds/dx)^T (dpsi/ds + viscous stress), so they sum
to zero, and so do their torques.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewax.lowering.assembled import assembled, at_elements
from rewax.lowering.kernels import joined, separated
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin.materials import Cloth, MembraneLaw, Rope
from rewax.physics.thin.stencils import Stencil
from rewax.types import Array, Scalar

Corners = tuple[Vec3, ...]
Strain = tuple[Array, Array, Array]
Inverse = tuple[Array, Array, Array, Array]
At = tuple[tuple[Vec3, Vec3], ...]
"""Positions and velocities at the corners of elements."""


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


def angle_between(angle: Array, other: Array) -> Array:
    """Difference of two angles of a hinge without full turns [rad], in [-pi, pi).

    A hinge of 180 degrees at rest, the seam of two sheets on each other, opens to either side of the jump of
    ``hinge_angle``.

    Gradient: exact; it jumps at half a turn.
    """
    difference = angle - other
    return difference - 2.0 * jnp.pi * jnp.floor(difference / (2.0 * jnp.pi) + 0.5)


def segment_strain(x: Corners, length: Array) -> Array:
    """Length over length at rest, minus 1 [-]."""
    edge = cp.subtract(x[1], x[0])
    return jnp.sqrt(cp.dot(edge, edge)) / length - 1.0


def half_square_curvature(x: Corners) -> Array:
    """|kb|^2 / 2 [-] with the curvature binormal kb = 2 a x b / (|a||b| + a . b), of length 2 tan(angle / 2).

    Source: Bergou et al. 2008, "Discrete elastic rods", eq. 1. Gradient: exact, finite for straight ropes and for ropes
      that are folded back onto themselves, see ``binormal_divisor``.
    """
    a, b = cp.subtract(x[1], x[0]), cp.subtract(x[2], x[1])
    product = cp.cross(a, b)
    divisor = binormal_divisor(a, b)
    return 2.0 * cp.dot(product, product) / (divisor * divisor)


def binormal_divisor(a: Vec3, b: Vec3) -> Array:
    """|a||b| + a . b [m^2]; that of a straight rope, 2 |a||b|, where b folds back onto a and the sum is rounding alone.

    The energy of such a fold is infinite, and no plane in which it could open is better than another. With this divisor
    it has no energy, no force and a finite derivative.
    """
    lengths = jnp.sqrt(cp.dot(a, a) * cp.dot(b, b))
    divisor = lengths + cp.dot(a, b)
    return jnp.where(divisor > 8.0 * jnp.finfo(lengths.dtype).eps * lengths, divisor, 2.0 * lengths)


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


def membrane_force(
    cloth: Cloth, law: MembraneLaw, triangles: Stencil, x: Vec3, v: Vec3, inverse: Inverse, area: Array
) -> Vec3:
    """Forces of the membrane on the vertices [N]. Gradient: exact."""
    shared, own = separated(cloth.replace(bending=None, bending_ratio=None, yield_curvature=None))
    return _membrane(law)(triangles, shared, (own, inverse, area), (x, v))


@functools.cache
def _membrane(law: MembraneLaw) -> Callable[[Any, Any, Any, Any], Vec3]:
    @assembled
    def membrane(shared: Cloth, given: tuple[tuple[Cloth, Inverse, Array], At]) -> Corners:
        (own, inverse, area), at = given
        cloth = joined(shared, own)
        strain, rate, pull = _linearized(lambda x: green_strain(x, inverse), *_split(at))
        elastic = membrane_stress(strain, cloth, law)
        viscous = membrane_stress(rate, cloth, MembraneLaw.SAINT_VENANT_KIRCHHOFF)
        return pull(cp.vector(lambda i: -area * (elastic[i] + cloth.damping * viscous[i])))

    return membrane


def hinge_force(
    stiffness: Scalar, damping: Scalar, hinges: Stencil, x: Vec3, v: Vec3, angle: Array, weight: Array
) -> Vec3:
    """Forces of bending on the vertices [N]: energy stiffness weight (theta - angle)^2 / 2. Gradient: exact.

    Source: Grinspun et al. 2003, "Discrete shells", with weight |e|^2 / (A_1 + A_2): for it ``stiffness`` is the
      flexural rigidity of cylinders along the lines of a rectangular sheet.
    """
    shared, own = separated((stiffness, damping))
    return _hinge(hinges, shared, (own, angle, weight), (x, v))


@assembled
def _hinge(shared: Any, given: tuple[tuple[Any, Array, Array], At]) -> Corners:
    (own, angle, weight), at = given
    stiffness, damping = joined(shared, own)
    theta, rate, pull = _linearized(hinge_angle, *_split(at))
    return pull(-stiffness * weight * (angle_between(theta, angle) + damping * rate))


def hinge_turn(damping: Scalar, hinges: Stencil, x: Vec3, v: Vec3, angle: Array) -> Array:
    """Angle of hinges minus that at rest, plus damping times its rate [rad]. Gradient: exact."""
    return _hinge_turn(hinges, (damping,), angle, (x, v))


@at_elements
def _hinge_turn(shared: Any, given: tuple[Array, At]) -> Array:
    angle, (x, v) = given[0], _split(given[1])
    theta, rate = jax.jvp(hinge_angle, (x,), (v,))
    return angle_between(theta, angle) + shared[0] * rate


def hinge_pull(hinges: Stencil, x: Vec3, moment: Array) -> Vec3:
    """Forces of moments [N m] of hinges on the vertices [N]: -moment dtheta/dx. Gradient: exact."""
    return _hinge_pull(hinges, (), moment, x)


@assembled
def _hinge_pull(shared: Any, given: tuple[Array, Corners]) -> Corners:
    del shared
    moment, x = given
    return jax.vjp(hinge_angle, x)[1](-moment)[0]


def segment_force(rope: Rope, segments: Stencil, x: Vec3, v: Vec3, length: Array) -> Vec3:
    """Forces of stretch on the vertices [N]. Gradient: exact."""
    shared, own = separated((rope.stretch, rope.damping))
    return _segment(segments, shared, (own, length), (x, v))


@assembled
def _segment(shared: Any, given: tuple[tuple[Any, Array], At]) -> Corners:
    (own, length), at = given
    stretch, damping = joined(shared, own)
    strain, rate, pull = _linearized(lambda x: segment_strain(x, length), *_split(at))
    return pull(-length * stretch * (strain + damping * rate))


def bend_force(bending: Scalar, bends: Stencil, x: Vec3, length: Array) -> Vec3:
    """Forces of bends on the vertices [N]: energy bending |kb|^2 / (2 length). Gradient: exact."""
    shared, own = separated((bending,))
    return _bend(bends, shared, (own, length), x)


@assembled
def _bend(shared: Any, given: tuple[tuple[Any, Array], Corners]) -> Corners:
    (own, length), x = given
    (bending,) = joined(shared, own)
    _, pull = jax.vjp(half_square_curvature, x)
    return pull(-bending / length + jnp.zeros_like(length))[0]


def _split(at: At) -> tuple[Corners, Corners]:
    """Positions and velocities of the corners."""
    return tuple(x for x, _ in at), tuple(v for _, v in at)


def _linearized(strain: Callable[[Corners], Any], x: Corners, v: Corners) -> tuple[Any, Any, Callable[[Any], Corners]]:
    """Strains, their rates, and the map from stresses to forces."""
    value, rate = jax.jvp(strain, (x,), (v,))
    _, pull = jax.vjp(strain, x)
    return value, rate, lambda stress: pull(stress)[0]


__all__ = [
    "angle_between", "bend_force", "binormal_divisor", "green_strain", "half_square_curvature", "hinge_angle",
    "hinge_force", "hinge_pull", "hinge_turn", "membrane_energy", "membrane_force", "membrane_stress", "segment_force",
    "segment_strain", "square_area_ratio",
]  # fmt: skip
