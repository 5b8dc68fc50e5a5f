"""Elastic and viscous parts of the incremental potential of cloth and ropes: slope, curvature, blocks.

An element with strains s(x), energy psi(s), stiffness D and damping time tau contributes to an implicit step of length
dt the energy psi(s) + tau / (2 dt) (s - s_0) D (s - s_0), with the strains s_0 at the beginning of the step. Its slope
is minus the force of backward Euler with the strain rate (s - s_0) / dt.

The curvature along p is (ds/dx)^T S' (ds/dx) p + S d^2s/dx^2 p with the stress S. The second part can be negative under
compression. The approximation ``exact`` = 0 keeps of it what is positive for every shape: tension.

Source: Radovitzky and Ortiz 1999, "Error estimation and adaptive meshing in strongly nonlinear dynamic problems", for
the incremental potential; Choi and Ko 2002, "Stable but responsive cloth", for the choice of the positive part.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.kernels import joined, pointwise, separated
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import elements
from rewax.physics.thin.bending import hinge_moments
from rewax.physics.thin.elements import Corners, Strain
from rewax.physics.thin.materials import MembraneLaw
from rewax.physics.thin.newton import Blocks, Linear
from rewax.physics.thin.stencils import Stencil, corners, scatter
from rewax.types import Array

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


class Before(NamedTuple):
    """Strains at the beginning of a step; None where there are no such elements."""

    membrane: Strain | None
    angle: Array | None
    segment: Array | None


class Local(NamedTuple):
    """An element type whose stress depends on its own strains alone."""

    strain: Callable[[Any, Any, Corners], Any]
    """``strain(parameters, sizes, x)``."""
    stress: Callable[[Any, Any, Any, Any], Any]
    """``stress(parameters, sizes, strain, dt)``, multiplied by the element's size."""
    tension: Callable[[Any, Any], Any]
    """``tension(stress, exact)``: the part of the stress whose second term of curvature counts."""


def strains_before(scene: "ThinScene", x: Vec3) -> Before:
    """The strains at the beginning of a step. Gradient: exact."""
    topology = scene.topology
    membrane = angle = segment = None
    if scene.cloth is not None:
        membrane = elements.green_strain(corners(topology.triangles, x), inverse_edges(scene))
        if len(topology.hinges):
            angle = hinge_angles(corners(topology.hinges, x))
    if scene.rope is not None:
        segment = elements.segment_strain(corners(topology.segments, x), scene.rest.length)
    return Before(membrane, angle, segment)


def elastic_slope(scene: "ThinScene", before: Before, x: Vec3) -> Vec3:
    """Minus the elastic and viscous forces of a step that ends at x [N]. Gradient: exact."""
    slopes = []
    for kind, stencil, parameters, sizes in _locals(scene, before):
        shared, own = separated(parameters)
        each = _slope(kind)((shared, jnp.asarray(scene.dt)), (own, sizes, corners(stencil, x)))
        slopes.append(scatter(stencil, each))
    if before.angle is not None:
        at = corners(scene.topology.hinges, x)
        pull = elements.hinge_pull(scene.topology.hinges, x, _moments(scene, before, at))
        slopes.append(cp.scale(-1.0, pull))
    return functools.reduce(cp.add, slopes)


def elastic_curvature(scene: "ThinScene", before: Before, x: Vec3, exact: Array) -> Linear:
    """The product with the derivative of ``elastic_slope`` if ``exact`` is 1, see the module. Gradient: none."""
    parts: list[Linear] = []
    for kind, stencil, parameters, sizes in _locals(scene, before):
        shared, own = separated(parameters)
        known, at = (shared, jnp.asarray(scene.dt), exact), (own, sizes, corners(stencil, x))

        def local(p: Vec3, kind: Local = kind, stencil: Stencil = stencil, known: Any = known, at: Any = at) -> Vec3:
            return scatter(stencil, _product(kind)(known, (*at, corners(stencil, p))))

        parts.append(local)
    if before.angle is not None:
        hinges = scene.topology.hinges
        at_hinges = corners(hinges, x)
        moment = _moments(scene, before, at_hinges)
        faster = 1.0 + _hinge_damping(scene) / scene.dt

        def bending(p: Vec3) -> Vec3:
            moved = corners(hinges, p)
            turned = _turned((faster,), (at_hinges, moved))
            each = _hinge_product((exact,), (at_hinges, moved, moment, hinge_moments(scene, turned)))
            return scatter(hinges, each)

        parts.append(bending)
    return lambda p: functools.reduce(cp.add, [part(p) for part in parts])


def elastic_blocks(scene: "ThinScene", before: Before, x: Vec3) -> Blocks:
    """The blocks on the diagonal of the positive definite curvature, without bending of cloth. Gradient: none."""
    diagonal = mixed = cp.vector(lambda i: jnp.zeros_like(x[i]))
    for kind, stencil, parameters, sizes in _locals(scene, before):
        shared, own = separated(parameters)
        each = _element_blocks(kind)((shared, jnp.asarray(scene.dt)), (own, sizes, corners(stencil, x)))
        diagonal = cp.add(diagonal, scatter(stencil, tuple(b.diagonal for b in each)))
        mixed = cp.add(mixed, scatter(stencil, tuple(b.mixed for b in each)))
    return Blocks(diagonal, mixed)


def inverse_edges(scene: "ThinScene") -> tuple[Array, Array, Array, Array]:
    """Inverse edge matrices of the triangles at rest, row by row."""
    B = scene.rest.inverse_edges
    return B[:, 0, 0], B[:, 0, 1], B[:, 1, 0], B[:, 1, 1]


# --- Triangles, segments and bends ------------------------------------------------------------------------------------


def _locals(scene: "ThinScene", before: Before) -> list[tuple[Local, Stencil, Any, Any]]:
    """The local elements of a scene: kind, corners, parameters, sizes."""
    topology, rest, found = scene.topology, scene.rest, []
    if scene.cloth is not None:
        cloth = scene.cloth.replace(bending=None, bending_ratio=None, yield_curvature=None)
        found.append(
            (_membrane(scene.law), topology.triangles, cloth, (inverse_edges(scene), rest.area, before.membrane))
        )
    if scene.rope is not None:
        rope = scene.rope
        found.append((_SEGMENT, topology.segments, (rope.stretch, rope.damping), (rest.length, before.segment)))
        if len(topology.bends):
            found.append((_BEND, topology.bends, (rope.bending,), (rest.bend_length,)))
    return found


@functools.cache
def _membrane(law: MembraneLaw) -> Local:
    def strain(cloth: Any, sizes: Any, x: Corners) -> Strain:
        del cloth
        return elements.green_strain(x, sizes[0])

    def stress(cloth: Any, sizes: Any, now: Strain, dt: Array) -> Strain:
        _, area, start = sizes
        elastic = elements.membrane_stress(now, cloth, law)
        change = cp.subtract(now, start)
        viscous = elements.membrane_stress(change, cloth, MembraneLaw.SAINT_VENANT_KIRCHHOFF)
        return cp.vector(lambda i: area * (elastic[i] + cloth.damping / dt * viscous[i]))

    return Local(strain, stress, _positive_part)


def _positive_part(stress: Strain, exact: Array) -> Strain:
    """The stress with its negative principal values times ``exact``."""
    a, b, c = stress
    mean, half = 0.5 * (a + b), 0.5 * (a - b)
    radius = cp.safe_sqrt(half * half + c * c)
    high, low = (jnp.where(p < 0, exact * p, p) for p in (mean + radius, mean - radius))
    apart = radius > 1e-6 * jnp.abs(mean)
    slope = jnp.where(apart, (high - low) / jnp.where(apart, 2.0 * radius, 1.0), 0.0)
    middle = 0.5 * (high + low)
    return middle + slope * half, middle - slope * half, slope * c


def _segment_stress(rope: Any, sizes: Any, now: Array, dt: Array) -> Array:
    (stretch, damping), (length, start) = rope, sizes
    return length * stretch * (now + damping / dt * (now - start))


def curvature_binormal(x: Corners) -> Vec3:
    """kb = 2 a x b / (|a||b| + a . b) [-], see ``elements.half_square_curvature``."""
    a, b = cp.subtract(x[1], x[0]), cp.subtract(x[2], x[1])
    return cp.scale(2.0 / elements.binormal_divisor(a, b), cp.cross(a, b))


_SEGMENT = Local(
    strain=lambda rope, sizes, x: elements.segment_strain(x, sizes[0]),
    stress=_segment_stress,
    tension=lambda stress, exact: jnp.where(stress < 0, exact * stress, stress),
)
_BEND = Local(
    strain=lambda rope, sizes, x: curvature_binormal(x),
    stress=lambda rope, sizes, now, dt: cp.scale(rope[0] / sizes[0], now),
    tension=lambda stress, exact: cp.scale(exact, stress),
)


@functools.cache
def _slope(kind: Local) -> Callable[[Any, Any], Corners]:
    @pointwise
    def slope(shared: Any, given: Any) -> Corners:
        (parameters, dt), (own, sizes, x) = shared, given
        parameters = joined(parameters, own)
        strain, pull = jax.vjp(lambda x: kind.strain(parameters, sizes, x), x)
        return pull(kind.stress(parameters, sizes, strain, dt))[0]

    return slope


@functools.cache
def _product(kind: Local) -> Callable[[Any, Any], Corners]:
    @pointwise
    def product(shared: Any, given: Any) -> Corners:
        (parameters, dt, exact), (own, sizes, x, p) = shared, given
        return _along(kind, joined(parameters, own), sizes, x, p, dt, exact)

    return product


def _along(kind: Local, parameters: Any, sizes: Any, x: Corners, p: Corners, dt: Array, exact: Any) -> Corners:
    """The curvature of an element along p."""

    def strain(x: Corners) -> Any:
        return kind.strain(parameters, sizes, x)

    now, change = jax.jvp(strain, (x,), (p,))
    stress, more = jax.jvp(lambda s: kind.stress(parameters, sizes, s, dt), (now,), (change,))
    kept = kind.tension(stress, exact)
    _, geometric = jax.jvp(lambda x: jax.vjp(strain, x)[1](kept)[0], (x,), (p,))
    (material,) = jax.vjp(strain, x)[1](more)
    return tuple(cp.add(a, b) for a, b in zip(material, geometric, strict=True))


@functools.cache
def _element_blocks(kind: Local) -> Callable[[Any, Any], tuple[Blocks, ...]]:
    @pointwise
    def blocks(shared: Any, given: Any) -> tuple[Blocks, ...]:
        (parameters, dt), (own, sizes, x) = shared, given
        parameters = joined(parameters, own)
        zero, one = jnp.zeros_like(x[0][0]), jnp.ones_like(x[0][0])
        found = []
        for k in range(len(x)):
            rows = []
            for i in cp.AXES:
                p = tuple(cp.vector(lambda j, c=c, k=k, i=i: one if (c, j) == (k, i) else zero) for c in range(len(x)))
                rows.append(_along(kind, parameters, sizes, x, p, dt, 0.0)[k])
            diagonal = cp.vector(lambda i, rows=rows: rows[i][i])
            found.append(Blocks(diagonal, cp.vector(lambda i, rows=rows: rows[(i + 1) % 3][(i + 2) % 3])))
        return tuple(found)

    return blocks


# --- Hinges -----------------------------------------------------------------------------------------------------------


def _moments(scene: "ThinScene", before: Before, at: Corners) -> Array:
    """Moments of hinges [N m]."""
    assert before.angle is not None
    angle = hinge_angles(at)
    turned, change = (elements.angle_between(angle, other) for other in (scene.rest.angle, before.angle))
    return hinge_moments(scene, turned + _hinge_damping(scene) / scene.dt * change)


def _hinge_damping(scene: "ThinScene") -> Array:
    assert scene.cloth is not None
    return jnp.max(scene.cloth.damping)


def hinge_angles(x: Corners) -> Array:
    """``elements.hinge_angle`` as one kernel. Gradient: exact."""
    return _angle((), x)


@pointwise
def _angle(shared: tuple, x: Corners) -> Array:
    del shared
    return elements.hinge_angle(x)


@pointwise
def _turned(shared: tuple[Array], given: tuple[Corners, Corners]) -> Array:
    x, p = given
    return shared[0] * jax.jvp(elements.hinge_angle, (x,), (p,))[1]


@pointwise
def _hinge_product(shared: tuple[Array], given: tuple[Corners, Corners, Array, Array]) -> Corners:
    x, p, moment, more = given
    kept = shared[0] * moment
    _, geometric = jax.jvp(lambda x: jax.vjp(elements.hinge_angle, x)[1](kept)[0], (x,), (p,))
    (material,) = jax.vjp(elements.hinge_angle, x)[1](more)
    return tuple(cp.add(a, b) for a, b in zip(material, geometric, strict=True))


__all__ = [
    "Before", "curvature_binormal", "elastic_blocks", "elastic_curvature", "elastic_slope", "hinge_angles",
    "inverse_edges", "strains_before",
]  # fmt: skip
