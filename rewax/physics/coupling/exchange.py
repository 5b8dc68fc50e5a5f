"""Exchange of momentum between a soft body and the rigid bodies that touch it.

Contact of light bodies with heavy soft ones is stiff: an explicit response would throw the body back and forth. So
contact uses the body's velocity after contact, the solution of six linear equations to which all contact points
contribute.

Each solver of soft bodies implements ``SoftContact`` (particles in ``nodes``, tetrahedra in ``vertices``). It does not
depend on the constraints of the rigid bodies: none in ``free``, joints in ``articulated``.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, Self

import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.physics.contact.motion import Motion
from rewax.physics.contact.patches import Wrench
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Mat3, Vec3
from rewax.physics.numerics.fields import checked, instance, integer
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.rotations import skew
from rewax.types import Array

WRENCH = instance(Wrench, "give a Wrench(force, torque), or None")


@checked(num_bodies=integer(0, "give the number of bodies"))
def no_wrench(num_bodies: int, like: Array | None = None) -> Wrench:
    """No force and no torque.

    Args:
      num_bodies: number of bodies.
      like: array that sets the dtype of the zeros, and inside ``shard_map`` the mesh axes along which they vary; the
        carry of a loop needs both. None: JAX's default float type.
    """
    zeros = jnp.zeros_like(jnp.zeros(()) if like is None else like, shape=(num_bodies, 3))
    return Wrench(zeros, jnp.zeros_like(zeros))


class System(NamedTuple):
    """Symmetric 6 x 6 system ((a, b), (b^T, c)) for a body's change of velocity and angular velocity.

    A contact point gives the momentum p - W J dV to a body whose twist changes by dV. W is symmetric, J = (1, -r x),
    and r is the point's arm about the body's origin. With the body's inertia M: (M + sum J^T W J) dV = sum J^T p.
    """

    a: Array
    b: Array
    c: Array
    right: Array


def no_system(dtype) -> System:
    """The system of a body without contact."""
    zeros = jnp.zeros((3, 3), dtype)
    return System(zeros, zeros, zeros, jnp.zeros(6, dtype))


def add_contact(system: System, arm: Vec3, normal: Vec3, along: Array, whole: Array, lost: Vec3) -> System:
    """Add the contact points of a collider to a system.

    Args:
      system: the system without them.
      arm: arm of each point about the body's origin [m], components of shape (num_points,).
      normal: unit vectors n [-].
      along, whole: W = along n n^T + whole 1 [kg].
      lost: p [kg m/s], momentum that the point loses at constant velocity of the body.

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


def add_contact_matrices(system: System, arm: Vec3, weights: Mat3, lost: Vec3) -> System:
    """``add_contact`` for points of any symmetric W [kg], components of shape (num_points,). Gradient: exact."""
    turned = [cp.cross(arm, row) for row in weights]
    twice = [cp.cross(arm, column) for column in zip(*turned, strict=True)]
    a, b, c = (jnp.stack([jnp.stack([jnp.sum(e) for e in row]) for row in m]) for m in (weights, turned, twice))
    right = jnp.stack([jnp.sum(e) for e in (*lost, *cp.cross(arm, lost))])
    return System(system.a + a, system.b + b, system.c + c, system.right + right)


class Received(NamedTuple):
    """Impulse [kg m/s] and angular impulse [kg m^2/s] on each body, shapes (num_bodies, 3)."""

    impulse: Array
    moment: Array

    def and_from(self, position: Vec3, lost: Vec3, body: int, origins: Array) -> "Received":
        """Add the momentum [kg m/s] that points lose to a body; moments are about origins [m], (num_bodies, 3)."""
        arm = cp.vector(lambda i: position[i] - origins[body, i])
        impulse, moment = (jnp.stack([jnp.sum(a) for a in v]) for v in (lost, cp.cross(arm, lost)))
        return Received(self.impulse.at[body].add(impulse), self.moment.at[body].add(moment))


class SoftContact(Protocol):
    """A soft body in the middle of a substep, after its own forces and before contact with bodies.

    Motions are velocity fields, one for each body.
    """

    def meet(self, poses: Pose, now: Sequence[Motion], before: Callable[[], Sequence[Motion]]) -> Self:
        """Evaluate contact geometry for bodies at the given poses (num_bodies, ...).

        ``now`` are the motions after the bodies' own forces of this substep, ``before`` those before them.
        """
        ...

    def system(self, body: int, origin: Array) -> System:
        """Contribution of contact to a body's equations of motion, for its twist at the origin [m], shape (3,)."""
        ...

    def exchange(self, motions: Sequence[Motion | None], origins: Array) -> tuple[Self, Received]:
        """The soft body after contact with bodies of these motions (None: unchanged), and the bodies' impulses.

        Moments are about origins [m], shape (num_bodies, 3).
        """
        ...

    def finish(self) -> Any:
        """The soft body at the end of the substep."""
        ...

    def given(self) -> tuple[Vec3, list[tuple[int, Vec3]]]:
        """After ``exchange``: contact points [m], and pairs of a body and the impulses [N s] that it receives there.

        One pair for each collider, and one of ``WALLS``.
        """
        ...
