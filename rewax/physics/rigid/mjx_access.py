"""Imports MJX without its warnings, and holds every access to MJX's private fields.

No other file of rewax imports ``mujoco.mjx``. MJX keeps the fields of its JAX backend in ``Data._impl``; the functions
below read and write them there. rewax calls only public functions of MJX, and replaces one for the time of a call.
"""

# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportArgumentType=false

import contextlib
import inspect
import io
import logging
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rewax.physics.rigid.tendon_wrap import wrap
from rewax.types import Array

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    # Without the optional package warp, MJX prints two warnings that do not concern its JAX backend.
    _level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    import mujoco
    from mujoco import mjx

    logging.disable(_level)


class ConstraintArrays(NamedTuple):
    """MJX's n constraint rows: equalities first, then dry friction, limits, contacts."""

    jacobian: Array
    """Shape (n, num_dofs)."""
    stiffness: Array
    """Inverse of the regularisation, shape (n,)."""
    target: Array
    """Reference acceleration of each row, shape (n,)."""
    friction_loss: Array
    """Largest force of dry friction, shape (n,)."""


def num_bounded_rows(d: mjx.Data) -> tuple[int, int]:
    """Number of constraint rows of equalities, and of dry friction."""
    return int(d._impl.ne), int(d._impl.nf)  # there is no public function that counts rows


def listed_collisions(m: mjx.Model, d: mjx.Data) -> mjx.Contact:
    """Contacts that ``mjx.collision`` finds in a model.

    Args:
      m: a model in which only explicit pairs of geoms can touch.
      d: MJX's data with the poses; its contacts are not read.
    """
    d = d.tree_replace({"_impl.ncon": m.npair})  # with 0 contacts, MJX would skip collision
    return mjx.collision(m, d)._impl.contact  # the only field with contacts


def constraint_arrays(m: mjx.Model, d: mjx.Data, contact: mjx.Contact | None) -> ConstraintArrays:
    """Rows of ``mjx.make_constraint`` for the model's equalities, friction and limits, and for the contacts."""
    if contact is not None:
        d = d.tree_replace({"_impl.contact": contact})  # where make_constraint reads them
    impl = mjx.make_constraint(m, d)._impl  # where make_constraint writes the rows
    return ConstraintArrays(impl.efc_J, impl.efc_D, impl.efc_aref, impl.efc_frictionloss)


def actuator_moments(d: mjx.Data) -> Array:
    """Moment arms of actuators from ``mjx.transmission``, shape (num_actuators, num_dofs)."""
    return d._impl.actuator_moment  # transmission returns them nowhere else


def tendon(m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """``mjx.tendon`` with the way around geoms of ``tendon_wrap``, but for tendons that pass inside a geom."""
    support = inspect.unwrap(mjx.tendon).__globals__["support"]  # the module in which mjx.tendon finds wrap
    theirs = support.wrap

    def wrapped(*args: Any) -> tuple[Array, Array, Array]:
        *geometry, inside = args[:9]
        if inside:
            return theirs(*args)
        length, *points = wrap(*(jnp.reshape(x, ()) if jnp.size(x) == 1 else x for x in geometry))
        return length[None], *points

    support.wrap = wrapped
    try:
        return mjx.tendon(m, d)
    finally:
        support.wrap = theirs


def tendon_jacobian(d: mjx.Data) -> Array:
    """Derivative of the tendons' lengths from ``mjx.tendon``, shape (num_tendons, num_dofs)."""
    return d._impl.ten_J  # tendon returns it nowhere else


def actuator_velocities(d: mjx.Data) -> Array:
    """Velocities set by ``with_actuator_velocities``, shape (num_actuators,)."""
    return d._impl.actuator_velocity  # where with_actuator_velocities writes them


def with_actuator_velocities(d: mjx.Data, velocity: Array) -> mjx.Data:
    """Data with actuator velocities, which ``mjx.fwd_actuation`` reads."""
    return d.tree_replace({"_impl.actuator_velocity": velocity})  # where fwd_actuation reads them


def with_tendon_velocities(d: mjx.Data, velocity: Array) -> mjx.Data:
    """Data with tendon velocities, which ``mjx.passive`` reads."""
    return d.tree_replace({"_impl.ten_velocity": velocity})  # where passive reads them


def contact_of(
    distance: Array, point: Array, frame: Array, parameters: tuple[Array, ...], geoms: Array, dim: np.ndarray
) -> mjx.Contact:
    """MJX's contacts; ``parameters`` are margin, friction, solref, solreffriction and solimp."""
    names = ("includemargin", "friction", "solref", "solreffriction", "solimp")
    return mjx.Contact(
        dist=distance, pos=point, frame=frame, **dict(zip(names, parameters, strict=True)),
        geom=geoms, geom1=geoms[:, 0], geom2=geoms[:, 1], dim=dim,
        efc_address=np.full(len(dim), -1),  # for sensors, which rewax leaves out
    )  # fmt: skip


__all__ = [
    "ConstraintArrays", "actuator_moments", "actuator_velocities", "constraint_arrays", "contact_of",
    "listed_collisions", "mjx", "mujoco", "num_bounded_rows", "tendon", "tendon_jacobian", "with_actuator_velocities",
    "with_tendon_velocities",
]  # fmt: skip
