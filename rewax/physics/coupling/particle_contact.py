"""Contact of particles with the triangles of a cloth: one force law on both sides of the cloth, with friction.

A particle at the distance D < h from the surface is pushed away from it, and the three corners of the closest triangle
receive the opposite force with the weights of the closest point; ``thin.SelfContact`` has the force. So forces sum to
zero, torques do too without friction, and without damping and friction the force is minus the gradient of an energy.

The energy of one particle is the sum over triangles, minus the sum over inner edges, plus the sum over inner corners,
each at its own distance. On a flat sheet this is the energy of one plane, everywhere: particles slide over edges
without a bump. In a fold both sides push.

Source: Li et al. 2023, Convergent incremental potential contact, for the sum; a polynomial in place of their barrier.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from rewax import struct
from rewax.lowering.assembled import assembled
from rewax.lowering.stencils import Listed
from rewax.physics.coupling.triangle_tree import EDGES, TriangleTree, close_to_triangles
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import closest
from rewax.physics.thin.pair_kernels import to_corners
from rewax.physics.thin.pair_law import PairContact, pair_energy, shared_out
from rewax.physics.thin.self_contact import NO_PAIR
from rewax.types import Array, Scalar


@struct.dataclass
class ParticleContact(PairContact):
    """Contact of particles with cloth: the force of ``thin.SelfContact`` between a particle and the closest triangles.

    Attributes:
      thickness: distance between the middles of particle and cloth below which they touch [m].
      stiffness: normal force of one particle per depth [N/m].
      damping: normal force per approaching speed [N s/m].
      friction: Coulomb coefficient [-].
      friction_damping: tangential force per sliding speed below Coulomb's limit [N s/m], > 0 with friction.
      max_speed: relative speed of particles and cloth up to which no pair is missed [m/s]; see
        ``largest_safe_particle_speed``.
      every: close pairs are searched every ``every`` substeps (static), or the largest divisor of the number of
        substeps below it.
      pairs_per_particle: capacity of the list of close pairs for each particle, on average (static).
    """

    pairs_per_particle: int = struct.static_field(default=8)


class ParticlePairs(NamedTuple):
    """Close pairs of a particle and a triangle, in lists of fixed length."""

    corners: Array
    """The particle, and the vertices counted after all particles, int32 of shape (4, capacity)."""
    thickness: Array
    """Distance at which a pair touches [m], shape (capacity,); negative beyond the last pair."""
    shares: tuple[Array, ...]
    """``TriangleTree.shares`` of each pair, six arrays (capacity,)."""
    num_pairs: Array
    """Number of pairs, which come first, int32 of shape ()."""
    full: Array
    """Whether pairs are missing, shape (), bool."""

    def listed(self, both: tuple[Vec3, Vec3]) -> Listed:
        """The pairs as elements of particles and vertices ``_together``."""
        return Listed(self.corners, self.num_pairs, both[0][0].shape[-1])


def particle_pairs(law: ParticleContact, tree: TriangleTree, dt: float, particles: Vec3, x: Vec3) -> ParticlePairs:
    """The pairs that can touch within the next ``every`` substeps of duration dt [s].

    Gradient: exact with respect to the thickness. The choice of pairs is a constant.
    """
    num_particles, dtype = particles[0].shape[-1], x[0].dtype
    reach = jnp.asarray(law.thickness + law.max_speed * law.every * dt, dtype)
    found = close_to_triangles(tree, particles, x, reach, law.pairs_per_particle * num_particles)
    corners = num_particles + jnp.asarray(tree.triangles.T)[:, found.triangles]
    thickness = jnp.where(found.valid, jnp.asarray(law.thickness, dtype), NO_PAIR)
    shares = tuple(jnp.asarray(column, dtype)[found.triangles] for column in tree.shares.T)
    return ParticlePairs(jnp.concatenate([found.points[None], corners]), thickness, shares, found.num_pairs, found.full)


def contact_forces(
    law: ParticleContact, pairs: ParticlePairs, particles: tuple[Vec3, Vec3], vertices: tuple[Vec3, Vec3]
) -> tuple[Vec3, Vec3]:
    """Forces on the particles and on the vertices [N], given positions [m] and velocities [m/s] of both.

    Gradient: exact.
    """
    num_particles, both = particles[0][0].shape[-1], _together(particles, vertices)
    total = pair_force(pairs.listed(both), numbers(law), (pairs.thickness, pairs.shares), both)
    on_particles = cp.vector(lambda i: total[i][:num_particles])
    return on_particles, cp.vector(lambda i: total[i][num_particles:])


def relative_speed(pairs: ParticlePairs, particles: tuple[Vec3, Vec3], vertices: tuple[Vec3, Vec3]) -> Array:
    """Largest speed of a particle relative to the closest point of a triangle of its pairs [m/s], shape ().

    Arguments as for ``contact_forces``. Gradient: none.
    """
    x, v = _at_corners(pairs, particles, vertices)
    speed = cp.norm(closest.weighted(closest.vertex_triangle(x), v))
    return jnp.max(jnp.where(pairs.thickness > 0, speed, 0.0))


def meeting_speed(
    law: ParticleContact, pairs: ParticlePairs, dt: float, particles: tuple[Vec3, Vec3], vertices: tuple[Vec3, Vec3]
) -> Array:
    """Largest speed at which a particle may meet the cloth before the next search [m/s], shape ().

    It is ``relative_speed`` of the pairs. A particle that is too far from the cloth for a pair, but may reach the
    cloth's middle before the next search, is faster than ``law.max_speed``. It counts with an upper bound of its
    relative speed where it may enter the box around the cloth. Other arguments as for ``contact_forces``; dt is the
    duration of a substep [s]. Gradient: none.
    """
    (x, v), (at, moving), time = particles, vertices, law.every * dt
    mean = cp.vector(lambda i: jnp.mean(moving[i]))
    speed = cp.norm(cp.subtract(v, mean)) + jnp.max(cp.norm(cp.subtract(moving, mean)))
    reaches = speed * time > law.thickness + law.max_speed * time
    for i in cp.AXES:
        reaches &= (x[i] + speed * time >= jnp.min(at[i])) & (x[i] - speed * time <= jnp.max(at[i]))
    return jnp.maximum(relative_speed(pairs, particles, vertices), jnp.max(jnp.where(reaches, speed, 0.0)))


def largest_depth(pairs: ParticlePairs, particles: tuple[Vec3, Vec3], vertices: tuple[Vec3, Vec3]) -> Array:
    """Largest depth of a particle in the cloth's thickness [-]: 0 where they touch, 1 at the middle, shape ().

    Arguments as for ``contact_forces``. Gradient: none.
    """
    x, _ = _at_corners(pairs, particles, vertices)
    distance, listed = cp.norm(closest.weighted(closest.vertex_triangle(x), x)), pairs.thickness > 0
    return jnp.max(jnp.where(listed, 1.0 - distance / jnp.where(listed, pairs.thickness, 1.0), 0.0), initial=0.0)


def _at_corners(pairs: ParticlePairs, particles: tuple[Vec3, Vec3], vertices: tuple[Vec3, Vec3]) -> list[Any]:
    """Positions and velocities of the particle and the corners of each pair."""
    both = _together(particles, vertices)
    flat = to_corners(pairs.listed(both), (*both[0], *both[1]))
    return [tuple((u[k], u[4 + k], u[8 + k]) for k in range(4)) for u in (flat[:12], flat[12:])]


def _together(particles: tuple[Vec3, Vec3], vertices: tuple[Vec3, Vec3]) -> tuple[Vec3, Vec3]:
    """Positions and velocities of the particles, then the vertices."""
    x, v = (
        cp.vector(lambda i, p=p, v=v: jnp.concatenate([p[i], v[i]])) for p, v in zip(particles, vertices, strict=True)
    )
    return x, v


@assembled
def pair_force(law: ParticleContact, pairs: tuple[tuple[Array, tuple[Array, ...]], Any]) -> tuple[Vec3, ...]:
    """Forces on a particle and the corners of a triangle [N], from thicknesses, shares, positions and velocities."""
    (thickness, shares), corners = pairs
    x, v = tuple(x for x, _ in corners), tuple(v for _, v in corners)

    def force(weights: closest.Weights) -> tuple[Vec3, ...]:
        between = closest.weighted(weights, x)
        return shared_out(law, weights, between, cp.dot(between, between), v, thickness)  # pyright: ignore[reportArgumentType]

    total = force(closest.vertex_triangle(x))
    features = [_on_edge(x, *edge) for edge in EDGES] + [_at_corner(x, k) for k in (1, 2, 3)]
    for share, weights in zip(shares, features, strict=True):
        total = tuple(cp.add(t, cp.scale(share, f)) for t, f in zip(total, force(weights), strict=True))
    return total


def _on_edge(x: Sequence[Vec3], i: int, j: int) -> closest.Weights:
    """Weights for the vertex x[0] and the segment from x[i] to x[j], see ``closest.Weights``."""
    along = cp.subtract(x[j], x[i])
    t = jnp.clip(cp.dot(along, cp.subtract(x[0], x[i])) / cp.dot(along, along), 0.0, 1.0)
    weights = [jnp.ones_like(t), jnp.zeros_like(t), jnp.zeros_like(t), jnp.zeros_like(t)]
    weights[i], weights[j] = t - 1.0, -t
    return tuple(weights)  # pyright: ignore[reportReturnType]


def _at_corner(x: Sequence[Vec3], k: int) -> closest.Weights:
    one, zero = jnp.ones_like(x[0][0]), jnp.zeros_like(x[0][0])
    return tuple(one if i == 0 else -one if i == k else zero for i in range(4))  # pyright: ignore[reportReturnType]


def numbers(law: ParticleContact) -> ParticleContact:
    """The law without what only the search needs."""
    return law.replace(thickness=1.0, max_speed=1.0, every=1, pairs_per_particle=1)


def stopping_energy(law: ParticleContact) -> Scalar:
    """Energy [J] that one particle needs to reach the middle of the cloth. Gradient: exact."""
    zero = jnp.zeros_like(jnp.asarray(law.thickness))
    return pair_energy(law, zero, jnp.asarray(law.thickness))  # pyright: ignore[reportArgumentType]


__all__ = ["ParticleContact", "ParticlePairs", "contact_forces", "largest_depth", "meeting_speed", "numbers",
           "particle_pairs", "relative_speed", "stopping_energy"]  # fmt: skip
