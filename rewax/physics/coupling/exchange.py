"""What nodes and the bodies that touch them give each other: momentum is exchanged, never made.

The contact of light bodies with heavy particles is stiff: a body that answered only after it took the particles'
momentum would be thrown back and forth. So the velocity that nodes are given is that which the body will have: a linear
system, formed from all nodes that approach it now. (Nodes that only the new velocity runs into are not in it: a light
body squeezed between heavy ones from two sides is the hard case.)
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from rewax.physics.contact.colliders import (
    MIN_INFLUENCE,
    Motion,
    Overlap,
    Touch,
    contact_velocity,
    friction_factor,
    nearest,
    velocity_at,
)
from rewax.physics.mpm.scene import MPMScene
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.materialize import materialize
from rewax.physics.numerics.rotations import skew
from rewax.types import Array


class Wrench(NamedTuple):
    """Force [N] and torque about the body's origin [N m] on each body, shapes (num_bodies, 3)."""

    force: Array
    torque: Array


def no_wrench(num_bodies: int, dtype=None) -> Wrench:
    """No force and no torque."""
    zeros = jnp.zeros((num_bodies, 3), dtype)
    return Wrench(zeros, zeros)


def at_velocity(scene: MPMScene, position: Vec3, touches: list[Touch], motions: Sequence[Motion | None]) -> list[Touch]:
    """The same touches with other motions of their bodies; None: as they were."""
    moved = [motions[collider.body] for collider in scene.colliders]
    return [
        t if motion is None else t._replace(velocity=velocity_at(motion, position))
        for motion, t in zip(moved, touches, strict=True)
    ]


def exchange(
    scene: MPMScene, position: Vec3, mass: Array, velocity: Vec3, touches: list[Touch], origins: Array
) -> tuple[Vec3, Array, Array]:
    """What nodes and bodies give each other.

    Args:
      scene: its colliders and how they overlap.
      position, mass, velocity: of the nodes [m, kg, m/s], (num_nodes,) each; mass 0 where nothing is.
      touches: of each collider, with the velocity that its body will have.
      origins: point of each body about which angular impulses count [m], shape (num_bodies, 3).

    Returns:
      Node velocities after contact; impulse on each body and angular impulse, shapes (num_bodies, 3). Gradient: exact.
    """
    impulses, moments = [jnp.zeros_like(origins)] * 2

    def give(body: int, before: Vec3, after: Vec3, weight: Array) -> None:
        nonlocal impulses, moments
        lost = cp.vector(lambda i: weight * (before[i] - after[i]))
        arm = cp.vector(lambda i: position[i] - origins[body, i])
        total, moment = (jnp.stack([jnp.sum(a) for a in v]) for v in (lost, cp.cross(arm, lost)))
        impulses, moments = impulses.at[body].add(total), moments.at[body].add(moment)

    if scene.overlap is Overlap.SEQUENTIAL or len(touches) < 2:
        for collider, t in zip(scene.colliders, touches, strict=True):
            before, velocity = velocity, materialize(contact_velocity(t, velocity))
            give(collider.body, before, velocity, mass)
        return velocity, impulses, moments
    best, shares = nearest(touches)
    after = materialize(contact_velocity(best, velocity))
    for collider, share in zip(scene.colliders, shares, strict=True):
        give(collider.body, velocity, after, share * mass)
    return after, impulses, moments


class System(NamedTuple):
    """Symmetric 6 x 6 system ((a, b), (b^T, c)) of a body's change of velocity and angular velocity."""

    a: Array
    b: Array
    c: Array
    right: Array


def contact_system(
    scene: MPMScene, position: Vec3, mass: Array, velocity: Vec3, touches: list[Touch], body: int, origin: Array
) -> System:
    """What contact adds to a body's equations of motion.

    It holds if nodes that approach now go on to, and friction acts as it would now. With J = (1, -r x) at each node, r
    its arm about ``origin``, a touch takes the momentum m W (v - J V) with a symmetric W from a body of twist V. With
    the body's inertia M: (M + sum m J^T W J) dV = sum m J^T W (v - J V).
    """
    alone = scene.overlap is Overlap.SEQUENTIAL or len(touches) < 2
    masses = [mass] * len(touches) if alone else [share * mass for share in nearest(touches)[1]]
    zeros = jnp.zeros((3, 3), mass.dtype)
    system = System(zeros, zeros, zeros, jnp.zeros(6, mass.dtype))
    arm = cp.vector(lambda i: position[i] - origin[i])
    for collider, t, weight in zip(scene.colliders, touches, masses, strict=True):
        if collider.body == body:
            system = _add_touch(system, arm, weight, velocity, t)
    return system


def _add_touch(system: System, arm: Vec3, mass: Array, velocity: Vec3, t: Touch) -> System:
    relative = cp.subtract(velocity, t.velocity)
    approach = jnp.minimum(cp.dot(relative, t.normal), 0.0)
    tangential = cp.vector(lambda i: relative[i] - approach * t.normal[i])
    sliding = friction_factor(tangential, approach, t.friction)
    after = contact_velocity(t, velocity)
    weight = jnp.where((approach < 0) & (t.influence > MIN_INFLUENCE), mass * t.influence, 0.0)
    # W = sliding n n^T + (1 - sliding) 1: sticking nodes take their whole velocity from the body, sliding ones only
    # that along the normal.
    along, whole = materialize((weight * sliding, weight * (1.0 - sliding)))
    q = materialize(jnp.stack([*t.normal, *cp.cross(arm, t.normal)]))
    s = materialize(jnp.stack([jnp.ones_like(arm[0]), *arm]))
    normal = jnp.einsum("an,bn->ab", along * q, q, precision="highest")
    moments = jnp.einsum("an,bn->ab", whole * s, s, precision="highest")
    second = moments[1:, 1:]
    eye = jnp.eye(3, dtype=second.dtype)
    lost = cp.vector(lambda i: mass * (velocity[i] - after[i]))
    right = jnp.stack([jnp.sum(a) for a in (*lost, *cp.cross(arm, lost))])
    return System(
        system.a + normal[:3, :3] + moments[0, 0] * eye,
        system.b + normal[:3, 3:] - skew(moments[0, 1:]),
        system.c + normal[3:, 3:] + jnp.trace(second) * eye - second,
        system.right + right,
    )
