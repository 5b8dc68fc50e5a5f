"""The contact law of cloth and ropes with themselves: a smooth repulsion of close pairs of elements, with friction.

``SelfContact`` has the force of a pair. The force of one element acts on its corners with the weights of the closest
point, the opposite force on the other's. So forces sum to zero, and without friction torques do too. The two friction
forces of a pair act at its two closest points: their torque is the distance times the friction. To act at one point
between the layers, they would have to bend the layers, which the corners of a pair cannot express: a vertex and a
segment have no normal of their own.

D of two segments is sqrt(|difference|^2 + (h/5)^2 ((2 s - 1)^2 + (2 t - 1)^2)) at its minimum over points s and t. The
difference is not the true distance except in the middle of both segments, but it makes the force continuous where
segments are parallel. It shortens the reach by at most 4 % at their ends. Up to this, the normal force of all pairs is
minus the gradient of an energy.
"""

import dataclasses

import jax.numpy as jnp

from rewax import struct
from rewax.lowering.assembled import assembled
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import NOT_NEGATIVE, POSITIVE, Number, friction_dampings, numbers_of, static_integer
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import closest
from rewax.types import Array, Scalar

At = tuple[tuple[Vec3, Vec3], ...]
"""Positions and velocities at the corners of pairs."""
ONSET = 0.25
"""Depth over thickness at which the force becomes linear."""
CROWD = 4
"""Pairs at one vertex that the largest stable substep allows for."""
SMOOTHING = 0.2
"""Length over thickness that keeps the closest points of parallel segments unique."""


@struct.dataclass
class PairContact(struct.Replaceable):
    """The numbers that all laws of contact between pairs share, see ``SelfContact``."""

    thickness: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())
    stiffness: Scalar = struct.number(POSITIVE, "give a force per depth in N/m", shape=())
    damping: Scalar = struct.number(NOT_NEGATIVE, "give a number of N s/m", shape=(), default=0.0)
    friction: Scalar = struct.number(NOT_NEGATIVE, "give a Coulomb coefficient", shape=(), default=0.0)
    friction_damping: Scalar = struct.number(NOT_NEGATIVE, "give a number of N s/m", shape=(), default=0.0)
    max_speed: Scalar = struct.number(POSITIVE, "give a speed in m/s", shape=(), default=1.0)
    every: int = struct.static_field(default=8)

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            if not each.metadata.get("pytree_node", True):
                static_integer(each.name, getattr(self, each.name), 1, "give an integer of at least 1")

    def legal_numbers(self, name: str) -> list[Number]:
        """The numbers of the law, which has this name in messages, with their legal values."""
        sliding = friction_dampings(f"{name}.friction_damping", self.friction_damping, self.friction)
        return [*numbers_of(self, f"{name}."), *sliding]


@struct.dataclass
class SelfContact(PairContact):
    """Contact of cloth and ropes with themselves and with each other.

    A pair is a vertex and a triangle, or two segments. It touches where its distance D is below the thickness h. With
    the depth c = h - D, the onset o = h/4, and v_n and v_t the normal and tangential relative velocity, its force is

        f = n f_n - v_t/|v_t| min(friction_damping min(c/o, 1) |v_t|, friction f_n),
        f_n = stiffness r(c) - damping min(c/o, 1) min(v_n, 0),

    where r(c) = c^2 / (2 o) up to c = o and c - o/2 beyond.

    Attributes:
      thickness: distance between the middle surfaces of two layers of cloth at which they touch [m]. ``make_scene``
        finds the neighbours that do not touch; ``check_status`` reports a thickness that would need others.
      rope_thickness: distance between the middle lines of two ropes at which they touch [m]; None: ``thickness``. Rope
        and cloth touch at the mean of both.
      stiffness: normal force per depth of a pair [N/m].
      damping: normal force per approaching speed of a pair [N s/m].
      friction: Coulomb coefficient [-].
      friction_damping: tangential force per sliding speed below Coulomb's limit [N s/m], > 0 with friction.
      max_speed: speed relative to the mean velocity of all vertices up to which no pair is missed [m/s]; see
        ``thin.largest_safe_speed``.
      every: close pairs are searched every ``every`` substeps (static), or the largest divisor of the number of
        substeps below it.
      pairs_per_element: capacity of the lists of close pairs (static): this number of pairs with triangles for each
        vertex, and with edges for each edge, on average.
    """

    rope_thickness: Scalar | None = struct.number(POSITIVE, "give a length in metres", shape=(), default=None)
    pairs_per_element: int = struct.static_field(default=8)

    def rope(self) -> Scalar:
        """Thickness of ropes [m]."""
        return self.thickness if self.rope_thickness is None else self.rope_thickness


def numbers(law: SelfContact) -> SelfContact:
    """The law without what only the search needs."""
    return law.replace(thickness=1.0, rope_thickness=None, max_speed=1.0, every=1, pairs_per_element=1)


def pair_stiffness(law: SelfContact) -> tuple[Scalar, Scalar]:
    """Largest stiffness [N/m] and damping [N s/m] at a vertex that ``CROWD`` pairs push. Gradient: exact.

    A spring between two points has twice its stiffness as eigenvalue.
    """
    return 2.0 * CROWD * law.stiffness, 2.0 * CROWD * law.damping


@assembled
def vertex_triangle_force(law: SelfContact, pairs: tuple[Array, At]) -> tuple[Vec3, ...]:
    """Forces on a vertex and the corners of a triangle [N], from thicknesses, positions and velocities."""
    thickness, (x, v) = pairs[0], _split(pairs[1])
    weights = closest.vertex_triangle(x)
    between = closest.weighted(weights, x)
    return shared_out(law, weights, between, cp.dot(between, between), v, thickness)


@assembled
def segments_force(law: SelfContact, pairs: tuple[Array, At]) -> tuple[Vec3, ...]:
    """Forces on the ends of two segments [N], from thicknesses, positions and velocities."""
    thickness, (x, v) = pairs[0], _split(pairs[1])
    smoothing = SMOOTHING * thickness
    weights = closest.segments(x, smoothing)
    between = closest.weighted(weights, x)
    square = smoothed_square(weights, between, smoothing)
    return shared_out(law, weights, between, square, v, thickness)


def _split(at: At) -> tuple[tuple[Vec3, ...], tuple[Vec3, ...]]:
    """Positions and velocities of the corners."""
    return tuple(x for x, _ in at), tuple(v for _, v in at)


def smoothed_square(weights: closest.Weights, between: Vec3, smoothing: Array) -> Array:
    """D^2 of two segments [m^2]."""
    s, t = weights[1] - weights[0], weights[3] - weights[2]
    return cp.dot(between, between) + smoothing * smoothing * (s * s + t * t)


def pair_energy(law: SelfContact, square: Array, thickness: Array) -> Array:
    """Energy of pairs [J] at squared distances D^2 [m^2]. Gradient: exact."""
    depth, onset = thickness - cp.safe_sqrt(square), ONSET * thickness
    beyond = jnp.maximum(depth - onset, 0.0)
    before = jnp.clip(depth, 0.0, onset)
    return law.stiffness * (before**3 / (6.0 * onset) + 0.5 * onset * beyond + 0.5 * beyond**2)


def shared_out(
    law: SelfContact, weights: closest.Weights, between: Vec3, square: Array, v: tuple[Vec3, ...], thickness: Array
) -> tuple[Vec3, ...]:
    """The force of each pair on its four corners."""
    distance, (_, n) = cp.safe_sqrt(square), cp.unit(between)
    depth, onset = thickness - distance, ONSET * thickness
    share = jnp.clip(depth / onset, 0.0, 1.0)
    spring = law.stiffness * jnp.where(depth < onset, 0.5 * share * depth, depth - 0.5 * onset)
    velocity = closest.weighted(weights, v)
    v_n = cp.dot(n, velocity)
    v_t = cp.vector(lambda i: velocity[i] - v_n * n[i])
    damped = -law.damping * share * jnp.minimum(v_n, 0.0)
    # D grows with the distance at the rate distance / D: this factor makes the spring the gradient of an energy.
    push = jnp.where(depth > 0, spring * cp.norm(between) * cp.safe_rsqrt(square) + damped, 0.0)
    limit, grip = law.friction * push, law.friction_damping * share
    speed2 = cp.dot(v_t, v_t)
    slides = grip * cp.safe_sqrt(speed2) > limit
    drag = jnp.where(slides, limit / jnp.sqrt(jnp.where(slides, speed2, 1.0)), jnp.where(limit > 0, grip, 0.0))
    force = cp.vector(lambda i: push * n[i] - drag * v_t[i])
    return tuple(cp.scale(w, force) for w in weights)


__all__ = ["ONSET", "SMOOTHING", "PairContact", "SelfContact", "numbers", "pair_energy", "pair_stiffness",
           "segments_force", "smoothed_square", "vertex_triangle_force"]  # fmt: skip
