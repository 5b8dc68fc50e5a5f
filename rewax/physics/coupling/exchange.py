"""What a soft body and the rigid bodies that touch it give each other: momentum is exchanged, never made.

The contact of light bodies with heavy soft ones is stiff: a body that answered only after it took what contact gives
would be thrown back and forth. So contact acts with the velocity that the body will have: a linear system of six
equations, to which everything that touches the body adds.

A solver of soft bodies takes part as a ``SoftContact`` (particles in ``nodes``, tetrahedra in ``vertices``). What holds
the rigid bodies is none of its business: nothing in ``free``, joints in ``articulated``.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, Self

import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.physics.contact.motion import Motion
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.rotations import skew
from rewax.types import Array


class Wrench(NamedTuple):
    """Force [N] and torque about the body's origin [N m] on each body, shapes (num_bodies, 3)."""

    force: Array
    torque: Array


def no_wrench(num_bodies: int, like: Array | None = None) -> Wrench:
    """No force and no torque.

    Args:
      num_bodies: how many there are.
      like: an array whose type the zeros get, and inside ``shard_map`` the axes along which devices differ; a loop
        that begins with them needs both. None: floating-point numbers of JAX's default type.
    """
    zeros = jnp.zeros_like(jnp.zeros(()) if like is None else like, shape=(num_bodies, 3))
    return Wrench(zeros, zeros)


class System(NamedTuple):
    """Symmetric 6 x 6 system ((a, b), (b^T, c)) of a body's change of velocity and angular velocity.

    A place in touch takes the momentum p - W J dV from a body whose twist changes by dV; W is symmetric, J = (1, -r x),
    r the place's arm about the body's origin. With the body's inertia M: (M + sum J^T W J) dV = sum J^T p.
    """

    a: Array
    b: Array
    c: Array
    right: Array


def no_system(dtype) -> System:
    """Of a body that nothing touches."""
    zeros = jnp.zeros((3, 3), dtype)
    return System(zeros, zeros, zeros, jnp.zeros(6, dtype))


def add_contact(system: System, arm: Vec3, normal: Vec3, along: Array, whole: Array, lost: Vec3) -> System:
    """The system with the places that a collider touches.

    Args:
      system: without them.
      arm: of each place about the body's origin [m], components of shape (num_places,).
      normal: unit vectors n [-].
      along, whole: W = along n n^T + whole 1 [kg].
      lost: p [kg m/s], what the place loses if the body's velocity does not change.

    Gradient: exact.
    """
    along, whole = materialize((along, whole))
    q = materialize(jnp.stack([*normal, *cp.cross(arm, normal)]))
    s = materialize(jnp.stack([jnp.ones_like(arm[0]), *arm]))
    twice = jnp.einsum("an,bn->ab", along * q, q, precision="highest")
    moments = jnp.einsum("an,bn->ab", whole * s, s, precision="highest")
    second = moments[1:, 1:]
    eye = jnp.eye(3, dtype=second.dtype)
    right = jnp.stack([jnp.sum(a) for a in (*lost, *cp.cross(arm, lost))])
    return System(
        system.a + twice[:3, :3] + moments[0, 0] * eye,
        system.b + twice[:3, 3:] - skew(moments[0, 1:]),
        system.c + twice[3:, 3:] + jnp.trace(second) * eye - second,
        system.right + right,
    )


class Received(NamedTuple):
    """Impulse [kg m/s] and angular impulse [kg m^2/s] on each body, shapes (num_bodies, 3)."""

    impulse: Array
    moment: Array

    def and_from(self, position: Vec3, lost: Vec3, body: int, origins: Array) -> "Received":
        """With the momentum [kg m/s] that places lose to a body; moments count about origins [m], (num_bodies, 3)."""
        arm = cp.vector(lambda i: position[i] - origins[body, i])
        impulse, moment = (jnp.stack([jnp.sum(a) for a in v]) for v in (lost, cp.cross(arm, lost)))
        return Received(self.impulse.at[body].add(impulse), self.moment.at[body].add(moment))


class SoftContact(Protocol):
    """A soft body in the middle of a substep: its own forces are known, what bodies give to it is not.

    Motions are velocity fields, one for each body.
    """

    def meet(self, poses: Pose, now: Sequence[Motion], before: Callable[[], Sequence[Motion]]) -> Self:
        """With the bodies at given poses (num_bodies, ...).

        ``now`` are motions after the bodies' own forces, which act in the whole substep, ``before`` those without.
        """
        ...

    def system(self, body: int, origin: Array) -> System:
        """What contact adds to a body's equations of motion; its twist is that at the origin [m], shape (3,)."""
        ...

    def exchange(self, motions: Sequence[Motion | None], origins: Array) -> tuple[Self, Received]:
        """After contact with bodies of these motions (None: as they were), and what the bodies got.

        Moments count about origins [m], shape (num_bodies, 3).
        """
        ...

    def finish(self) -> Any:
        """The soft body at the end of the substep."""
        ...
