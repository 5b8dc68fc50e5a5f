"""Contacts and joint limits of articulated bodies as springs and dampers."""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics.contact.penalty import PenaltyContact, penalty_force
from rewax.physics.numerics.arguments import check_instance, check_plain
from rewax.physics.numerics.checks import NOT_NEGATIVE, Number, check_numbers, numbers_of
from rewax.physics.numerics.components import join_vector, split_vector
from rewax.physics.rigid.kinematics import Kinematics, moving_points
from rewax.types import Array, Scalar

_UNIT = "see Penalty for its unit"


@struct.dataclass
class Penalty(struct.Replaceable):
    """Contact and joint limits as springs and dampers, explicit in time.

    Friction coefficients are those of the geoms. Explicit integration bounds stiffness and damping: roughly
    stiffness dt^2 < mass and damping dt < mass.

    Attributes:
      stiffness: normal force per penetration [N/m].
      damping: normal force per approaching speed [N s/m].
      friction_damping: tangential force per sliding speed while below Coulomb's limit [N s/m]. 0: no friction, whatever
        the geoms' coefficients, and no gradient with respect to them.
      onset: depth over which both dampings rise to their full value [m]. 0: at once, a jump in time that gradients do
        not see.
      depth_damping: additional normal force per depth and approaching speed [N s/m^2].
      limit_stiffness, limit_damping: torque or force of a joint limit per angle or distance beyond it [N m/rad, N/m],
        and per rate [N m s/rad, N s/m].
      among: contact law between bodies of one tree; its ``limit_*`` are ignored. None: this law.
      at_surfaces: where a contact acts (static). False: halfway between the two surfaces. True: on each body at its own
        surface, the deepest point of its shape, as in NVIDIA Warp. Friction between two bodies then exerts an
        unbalanced torque of depth times force.
      boxes_touch_once: contact of explicit box-box pairs (static). False: at up to four points, found by MJX. True: at
        one point, which takes less time; see ``box_box``.
    """

    stiffness: Scalar = struct.number(NOT_NEGATIVE, _UNIT)
    damping: Scalar = struct.number(NOT_NEGATIVE, _UNIT, default=0.0)
    friction_damping: Scalar = struct.number(NOT_NEGATIVE, _UNIT, default=0.0)
    onset: Scalar = struct.number(NOT_NEGATIVE, _UNIT, default=0.0)
    depth_damping: Scalar = struct.number(NOT_NEGATIVE, _UNIT, default=0.0)
    limit_stiffness: Scalar = struct.number(NOT_NEGATIVE, _UNIT, default=1e3)
    limit_damping: Scalar = struct.number(NOT_NEGATIVE, _UNIT, default=10.0)
    among: "Penalty | None" = None
    at_surfaces: bool = struct.static_field(default=False)
    boxes_touch_once: bool = struct.static_field(default=False)

    def contact(self) -> PenaltyContact:
        """The contact law without the joint limits. Gradient: exact."""
        return PenaltyContact(**{name: getattr(self, name) for name in _CONTACT})


_CONTACT = ("stiffness", "damping", "friction_damping", "onset", "depth_damping")


def penalty_numbers(penalty: Penalty) -> list[Number]:
    """Parameters of the law with their legal values."""
    laws = (penalty, *([] if penalty.among is None else [penalty.among]))
    return [number for law in laws for number in numbers_of(law, "the penalty's ")]


def check_penalty(penalty: Penalty, mass: float, dt: float) -> None:
    """Raises a ValueError for illegal parameters, and for parameters that are unstable for any contact.

    Args:
      penalty: the law.
      mass: mass of the heaviest tree of bodies [kg].
      dt: duration of a substep [s].
    """
    check_instance("penalty", penalty, Penalty, "give a Penalty(stiffness=...)")
    if penalty.among is not None:
        check_instance("the penalty's among", penalty.among, Penalty, "give a Penalty(stiffness=...), or None")
        check_penalty(penalty.among, mass, dt)
    for number in penalty_numbers(penalty):
        check_plain(number.name, number.value, number.remedy)
        check_numbers([number])
        if np.ndim(number.value):
            raise ValueError(f"{number.name} has shape {np.shape(number.value)}: give one number")
    for name in ("at_surfaces", "boxes_touch_once"):
        check_instance(f"the penalty's {name}", getattr(penalty, name), bool, "give True or False")
    for name, unit, bound in (("stiffness", "N/m", 4.0 * mass / dt**2), ("damping", "N s/m", 2.0 * mass / dt)):
        value = getattr(penalty, name)
        if not isinstance(value, jax.core.Tracer) and np.max(value) > bound:
            raise ValueError(
                f"the penalty's {name} is {np.max(value):g} {unit}, unstable with a substep of {dt:g} s even for all "
                f"{mass:g} kg at once (at most {bound:.3g}, far less for light links): make it softer or dt shorter"
            )


class PointForces(NamedTuple):
    """Forces of n contacts on the second bodies, then on the first."""

    body: Array
    """Indices of bodies, shape (2n,)."""
    point: Array
    """Where the force acts [m], world, shape (2n, 3)."""
    force: Array
    """[N], world axes, shape (2n, 3)."""
    wrenches_of: Callable[[Array], Array]
    """``kinematics.moving_points``: from forces to wrenches on the bodies."""

    def wrenches(self) -> Array:
        """Wrenches on all bodies, for ``kinematics.generalized_forces``, shape (num_bodies, 6)."""
        return self.wrenches_of(self.force)


def point_forces(
    penalty: Penalty,
    kin: Kinematics,
    velocities: Array,
    *,
    distance: Array,
    point: Array,
    normal: Array,
    friction: Array,
    bodies: Array,
    half_gap: Array | None = None,
    of_one_tree: Array | None = None,
) -> PointForces:
    """Forces of contacts on the bodies.

    Args:
      penalty: the law.
      kin: kinematics of the tree.
      velocities: spatial velocities of the bodies, shape (num_bodies, 6).
      distance: distance between the surfaces [m], negative inside, shape (n,).
      point: contact points in the world [m], shape (n, 3).
      normal: unit normals from the first body to the second, world axes, shape (n, 3).
      friction: Coulomb coefficients [-], shape (n,).
      bodies: first and second body of each contact, shape (n, 2), int.
      half_gap: half the distance between the surfaces [m], negative inside, shape (n,); read if ``at_surfaces``.
      of_one_tree: whether both bodies belong to one tree, shape (n,), bool; read if the law has ``among``.

    Gradient: exact; see ``penalty.penalty_force``.
    """
    first, second = bodies[:, 0], bodies[:, 1]
    on_first, on_second = point, point
    if penalty.at_surfaces and half_gap is not None:
        shift = half_gap[:, None] * normal
        on_first, on_second = point - shift, point + shift
    body, acts_at = jnp.concatenate([second, first]), jnp.concatenate([on_second, on_first])
    speed, wrenches = moving_points(kin, velocities, body, acts_at)
    sliding = speed[: len(distance)] - speed[len(distance) :]
    law = penalty.contact()
    if penalty.among is not None and of_one_tree is not None:
        law = jax.tree.map(lambda a, b: jnp.where(of_one_tree, a, b), penalty.among.contact(), law)
    force = join_vector(penalty_force(law, distance, split_vector(normal), split_vector(sliding), friction))
    return PointForces(body, acts_at, jnp.concatenate([force, -force]), wrenches)


def limit_forces(penalty: Penalty, limits: Array, position: Array, rate: Array) -> Array:
    """Forces of joint limits [N m, or N for slides], shape (n,).

    Args:
      penalty: the law.
      limits: lower and upper limits, shape (n, 2).
      position, rate: position and rate of each joint, shape (n,).

    Gradient: exact, except for the jump of the damping at the limit.
    """
    beyond = jnp.minimum(position - limits[:, 0], 0.0) + jnp.maximum(position - limits[:, 1], 0.0)
    return jnp.where(beyond != 0, -penalty.limit_stiffness * beyond - penalty.limit_damping * rate, 0.0)


__all__ = ["Penalty", "PointForces", "check_penalty", "limit_forces", "penalty_numbers", "point_forces"]
