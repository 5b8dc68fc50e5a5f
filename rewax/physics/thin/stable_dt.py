"""The largest stable substep of cloth and ropes."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.thin.bending import bending_stiffness
from rewax.physics.thin.grasps import grasp_stiffness
from rewax.physics.thin.pair_law import pair_stiffness
from rewax.types import Array, Scalar

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene

STABLE_FRACTION = 0.8
"""Fraction of the bound that ``largest_stable_dt`` derives."""


@jax.jit  # the trace is kept: every check of a status repeats this bound
def largest_stable_dt(scene: "ThinScene") -> Scalar:
    """Largest substep [s] at which the explicit integration of a body at rest stays stable.

    The stiffness at a vertex is at most the sum K of the largest eigenvalues of its elements' stiffness matrices, plus
    the contact's stiffness. Those are, or are at most: area M sum_k |grad N_k|^2 of a triangle with the largest modulus
    M; ``bending.bending_stiffness``; 2 stretch / length of a segment; bending / length |d theta/dx|^2 of a bend. With
    the damping C bounded alike, symplectic Euler is stable up to 4 / (c + sqrt(c^2 + 4 w^2)) with w^2 = K/m and
    c = C/m + drag. The result is 0.8 of the smallest bound of all vertices that move.

    Tension adds stiffness that this bound, of a body at rest, does not include; strains above 0.5 need a margin.
    Friction damping and ``depth_damping`` are not included, and contact is included once, although several bodies can
    push one vertex.
    Self-contact is included for ``pair_law.CROWD`` pairs at a vertex, and every grasp as if it were closed.

    Implicit steps have no limit: the result is infinite.

    Gradient: exact.
    """
    if scene.stepper is not None:
        return jnp.full((), jnp.inf, scene.mass.dtype)
    topology, rest = scene.topology, scene.rest
    stiffness = damping = jnp.zeros_like(scene.mass)

    def added(total: Array, indices: np.ndarray, each: Array) -> Array:
        return total.at[indices].add(jnp.broadcast_to(each, indices.shape[:1])[:, None])

    if scene.cloth is not None:
        cloth = scene.cloth
        B = rest.inverse_edges
        slopes = jnp.sum(B**2, axis=(1, 2)) + jnp.sum(jnp.sum(B, axis=1) ** 2, axis=1)
        modulus = jnp.maximum(jnp.maximum(cloth.warp, cloth.weft) + jnp.abs(cloth.coupling), 2.0 * cloth.shear)
        triangle = rest.area * slopes * modulus
        stiffness = added(stiffness, topology.triangles.indices, triangle)
        damping = added(damping, topology.triangles.indices, triangle * cloth.damping)
        if len(topology.hinges):
            bending = bending_stiffness(scene)
            stiffness, damping = stiffness + bending, damping + bending * jnp.max(cloth.damping)
    if scene.rope is not None:
        rope, ends, inner = scene.rope, topology.segments.indices, topology.bends.indices
        segment = 2.0 * rope.stretch / rest.length
        # For segments of lengths a and b: 1/a^2 + 1/b^2 + (1/a + 1/b)^2 <= 6 / min(a, b)^2.
        shortest = jnp.full_like(scene.mass, jnp.inf).at[ends].min(rest.length[:, None])[inner[:, 1]]
        bend = 6.0 * rope.bending / (rest.bend_length * shortest**2)
        stiffness = added(added(stiffness, ends, segment), inner, bend)
        damping = added(damping, ends, segment * rope.damping)
    if scene.contact is not None:
        stiffness, damping = stiffness + scene.contact.stiffness, damping + scene.contact.damping
    if scene.self_contact is not None:
        spring, damper = pair_stiffness(scene.self_contact)
        stiffness, damping = stiffness + spring, damping + damper
    if scene.grasps:
        spring, damper = grasp_stiffness(scene)
        stiffness, damping = stiffness + spring, damping + damper
    w2, c = stiffness / scene.mass, damping / scene.mass + scene.drag
    limit = 4.0 / (c + jnp.sqrt(c * c + 4.0 * w2))
    if scene.mobility is not None:
        limit = jnp.where(scene.mobility > 0, limit, jnp.inf)
    return STABLE_FRACTION * jnp.min(limit)


__all__ = ["largest_stable_dt"]
