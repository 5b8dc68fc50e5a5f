"""Margins, friction and impedance of contacts: given by explicit pairs, else mixed from the two geoms."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.rigid.geom_pairs import GeomPairs
from rewax.physics.rigid.mjx_access import mjx, mujoco
from rewax.types import Array


class ContactParameters(NamedTuple):
    """MuJoCo's parameters of n contacts."""

    margin: Array
    """Distance [m] below which a contact is active, shape (n,)."""
    friction: Array
    """Coefficients: two sliding, one torsional, two rolling, shape (n, 5)."""
    solref: Array
    """Reference time constant and damping ratio, or minus stiffness and damping, shape (n, 2)."""
    solreffriction: Array
    """The same for the friction dimensions of an elliptic cone, shape (n, 2)."""
    solimp: Array
    """Impedance parameters, shape (n, 5)."""


def contact_parameters(mj: mujoco.MjModel, m: mjx.Model, pairs: GeomPairs) -> ContactParameters:
    """Parameters of n pairs of geoms.

    Args:
      mj: the model with its static fields.
      m: the same model with parameters that may be traced.
      pairs: the geoms; explicit pairs come first.

    Gradient: exact with respect to the fields of pairs and geoms.
    Source: MuJoCo MJX 3.17, ``collision_driver._contact_groups``. The geom of higher priority decides alone.
    """
    is_listed = pairs.listed >= 0
    parts = []
    if np.any(is_listed):
        parts.append(_listed_parameters(mj, m, pairs.listed[is_listed]))
    if not np.all(is_listed):
        parts.append(_mixed_parameters(mj, m, *pairs.geoms[~is_listed].T))
    return jax.tree.map(lambda *a: jnp.concatenate(a), *parts) if len(parts) > 1 else parts[0]


def _listed_parameters(mj: mujoco.MjModel, m: mjx.Model, pair: np.ndarray) -> ContactParameters:
    friction = jnp.clip(m.pair_friction[pair], min=mujoco.mjMINVAL)
    solreffriction = jnp.asarray(mj.pair_solreffriction[pair], friction.dtype)
    return ContactParameters(m.pair_margin[pair], friction, m.pair_solref[pair], solreffriction, m.pair_solimp[pair])


def _mixed_parameters(mj: mujoco.MjModel, m: mjx.Model, first: np.ndarray, second: np.ndarray) -> ContactParameters:
    margin = m.geom_margin[first] + m.geom_margin[second]
    priority = mj.geom_priority[first] - mj.geom_priority[second]
    one, other = np.where(priority < 0, second, first), np.where(priority > 0, first, second)
    mix = _mix(mj, one, other, margin.dtype)[:, None]
    friction = jnp.maximum(m.geom_friction[one], m.geom_friction[other])[:, [0, 0, 1, 2, 2]]
    solref, other_solref = m.geom_solref[one], m.geom_solref[other]
    is_standard = (solref[:, [0, 0]] > 0) & (other_solref[:, [0, 0]] > 0)  # else minus stiffness, damping
    mixed = mix * solref + (1 - mix) * other_solref
    solref = jnp.where(is_standard, mixed, jnp.minimum(solref, other_solref))
    solimp = mix * m.geom_solimp[one] + (1 - mix) * m.geom_solimp[other]
    return ContactParameters(margin, friction, solref, jnp.zeros_like(solref), solimp)


def _mix(mj: mujoco.MjModel, first: np.ndarray, second: np.ndarray, dtype: Any) -> np.ndarray:
    """Weight of the first geom in mixed parameters, shape (n,)."""
    weight, other = (mj.geom_solmix[geom].astype(dtype) for geom in (first, second))
    tiny, other_tiny = weight < mujoco.mjMINVAL, other < mujoco.mjMINVAL
    share = weight / np.where(tiny & other_tiny, 1, weight + other)
    return np.select([first == second, tiny & other_tiny, tiny, other_tiny], [1.0, 0.5, 0.0, 1.0], share).astype(dtype)


__all__ = ["ContactParameters", "contact_parameters"]
