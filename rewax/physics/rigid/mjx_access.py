"""MJX, imported quietly, and all that rewax uses of it without a public name.

MJX keeps what its JAX backend alone has in ``Data._impl`` and warns where it is read without that name. So every field
below is read and written there; no other file names one, and no function of MJX that is not public is called.
"""

# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportArgumentType=false

import contextlib
import io
import logging
from typing import NamedTuple

import numpy as np

from rewax.types import Array

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    # Without the optional package warp MJX prints two warnings that mean nothing to its JAX implementation.
    _level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    import mujoco
    from mujoco import mjx

    logging.disable(_level)


class ConstraintArrays(NamedTuple):
    """What MJX says of n constraint rows: equalities first, then dry friction, limits, contacts."""

    jacobian: Array
    """Shape (n, num_dofs)."""
    stiffness: Array
    """Inverse of the regularisation, shape (n,)."""
    target: Array
    """Acceleration that each row asks for, shape (n,)."""
    friction_loss: Array
    """Largest force of dry friction, shape (n,)."""


def num_bounded_rows(d: mjx.Data) -> tuple[int, int]:
    """How many constraint rows are equalities, and how many dry friction."""
    return int(d._impl.ne), int(d._impl.nf)  # there is no public function that counts rows


def listed_collisions(m: mjx.Model, d: mjx.Data) -> mjx.Contact:
    """Contacts that ``mjx.collision`` finds in a model.

    Args:
      m: a model, of which explicit pairs of geoms alone can touch.
      d: its poses; what it holds of contacts is not read.
    """
    d = d.tree_replace({"_impl.ncon": m.npair})  # with 0, as in data without contacts, MJX looks for none
    return mjx.collision(m, d)._impl.contact  # contacts have no other place


def constraint_arrays(m: mjx.Model, d: mjx.Data, contact: mjx.Contact | None) -> ConstraintArrays:
    """Rows that ``mjx.make_constraint`` makes of the model's equalities, friction and limits, and of contacts."""
    if contact is not None:
        d = d.tree_replace({"_impl.contact": contact})  # from where make_constraint takes them
    impl = mjx.make_constraint(m, d)._impl  # where it leaves the rows
    return ConstraintArrays(impl.efc_J, impl.efc_D, impl.efc_aref, impl.efc_frictionloss)


def actuator_moments(d: mjx.Data) -> Array:
    """Moment arms of actuators, as ``mjx.transmission`` found them, shape (num_actuators, num_dofs)."""
    return d._impl.actuator_moment  # transmission has no other result that holds them


def tendon_jacobian(d: mjx.Data) -> Array:
    """Derivative of tendons' lengths, as ``mjx.tendon`` found it, shape (num_tendons, num_dofs)."""
    return d._impl.ten_J  # tendon has no other result that holds it


def actuator_velocities(d: mjx.Data) -> Array:
    """Set by ``with_actuator_velocities``, shape (num_actuators,)."""
    return d._impl.actuator_velocity  # see there


def with_actuator_velocities(d: mjx.Data, velocity: Array) -> mjx.Data:
    """Data for ``mjx.fwd_actuation``."""
    return d.tree_replace({"_impl.actuator_velocity": velocity})  # it reads them there


def with_tendon_velocities(d: mjx.Data, velocity: Array) -> mjx.Data:
    """Data for ``mjx.passive``."""
    return d.tree_replace({"_impl.ten_velocity": velocity})  # it reads them there


def contact_of(
    distance: Array, point: Array, frame: Array, parameters: tuple[Array, ...], geoms: Array, dim: np.ndarray
) -> mjx.Contact:
    """Contacts as MJX has them; ``parameters`` are margin, friction, solref, solreffriction and solimp."""
    names = ("includemargin", "friction", "solref", "solreffriction", "solimp")
    return mjx.Contact(
        dist=distance, pos=point, frame=frame, **dict(zip(names, parameters, strict=True)),
        geom=geoms, geom1=geoms[:, 0], geom2=geoms[:, 1], dim=dim,
        efc_address=np.full(len(dim), -1),  # of sensors, which rewax leaves out
    )  # fmt: skip


__all__ = [
    "ConstraintArrays", "actuator_moments", "actuator_velocities", "constraint_arrays", "contact_of",
    "listed_collisions", "mjx", "mujoco", "num_bounded_rows", "tendon_jacobian", "with_actuator_velocities",
    "with_tendon_velocities",
]  # fmt: skip
