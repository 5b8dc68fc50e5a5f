"""Contacts of a model. rewax collides the kinds of geoms that it has functions for, and MJX all others.

All users of MJX in a process share its one table of collision functions, so rewax does not change it. Instead it gives
MJX a model whose only contacts are explicit pairs: those that MJX has to collide.
"""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.rigid.built_in_pairs import BUILT_IN_PAIRS, UNDER_A_PENALTY
from rewax.physics.rigid.contact_pair import ContactPair, Geom, find
from rewax.physics.rigid.contact_parameters import ContactParameters, contact_parameters
from rewax.physics.rigid.geom_pairs import GeomPairs, geom_pairs
from rewax.physics.rigid.mjcf import limit
from rewax.physics.rigid.mjx_access import contact_of, listed_collisions, mjx, mujoco
from rewax.physics.rigid.shown_to_mjx import with_one_group
from rewax.types import Array

_ENDLESS = {"plane", "hfield"}
"""Kinds without a bounding sphere: ``max_geom_pairs`` does not apply to their pairs."""


class Collisions(NamedTuple):
    """Static: which geoms of a model may touch, and which function finds their contacts.

    Attributes:
      mj: MuJoCo's model.
      groups: pairs of geoms.
      functions: the function of each group; None: MJX finds the contacts.
      max_geom_pairs: number of pairs of a group that are collided, those with the nearest bounding spheres; None: all.
      max_contact_points: number of contacts kept of each condim, the deepest; None: all.
    """

    mj: mujoco.MjModel
    groups: tuple[GeomPairs, ...]
    functions: tuple[ContactPair | None, ...]
    max_geom_pairs: int | None
    max_contact_points: int | None

    @property
    def mjx_groups(self) -> list[GeomPairs]:
        return [group for group, pair in zip(self.groups, self.functions, strict=True) if pair is None]


def collisions(
    mj: mujoco.MjModel, listed: np.ndarray, *, penalty: bool = False, added: Sequence[ContactPair] = ()
) -> Collisions:
    """Which geoms of a model may touch, and which function finds their contacts.

    Args:
      mj: MuJoCo's model.
      listed: ids of the explicit pairs to include, shape (n,).
      penalty: whether contacts follow a penalty law.
      added: the user's contact pairs. They replace built-in pairs of the same kinds.
    """
    known = {pair.kinds: pair for pair in (*(UNDER_A_PENALTY if penalty else BUILT_IN_PAIRS), *added)}
    most_pairs, most_points = limit(mj, "max_geom_pairs"), limit(mj, "max_contact_points")
    groups = geom_pairs(mj, listed) if most_points != 0 else ()
    groups = tuple(group for group in groups if most_pairs != 0 or _ENDLESS & {*group.kinds})
    return Collisions(mj, groups, tuple(known.get(group.kinds) for group in groups), most_pairs, most_points)


class _Contacts(NamedTuple):
    """n contacts of geoms."""

    distance: Array
    point: Array
    frame: Array
    parameters: ContactParameters
    geoms: Array | np.ndarray
    """Ids of the two geoms, shape (n, 2); a NumPy array if they are static."""


def collide(found: Collisions, m: mjx.Model, d: mjx.Data) -> mjx.Contact:
    """Contacts of all geoms that may touch, in MJX's order: by dimension, by group, by pair.

    Args:
      found: the groups of pairs and their functions.
      m: MJX's model ``without_contacts``, with parameters that may be traced.
      d: MJX's data with the poses of the geoms.

    Returns:
      MJX's contacts [m]. Unused slots have a distance above their margin.

    Gradient: that of the pairs' functions; for MJX's functions, MJX's own.
    Source: MuJoCo MJX 3.17, ``collision_driver.collision``. Order and parameters agree with it to the bit.
    """
    if found.max_geom_pairs is not None:
        m = m.replace(geom_rbound=_bounding_radii(found.mj, m))
    by_dim: dict[int, list[_Contacts]] = {}
    for group, pair in zip(found.groups, found.functions, strict=True):
        by_dim.setdefault(group.condim, []).append(_group_contacts(found, m, d, group, pair))
    if found.max_contact_points is not None:
        by_dim = {dim: [_deepest(found.max_contact_points, parts)] for dim, parts in by_dim.items()}
    dims = [np.full(len(part.distance), dim) for dim in sorted(by_dim) for part in by_dim[dim]]
    parts = [part for dim in sorted(by_dim) for part in by_dim[dim]] or [_none(d.geom_xpos.dtype)]
    every = _joined(parts)
    geoms = jnp.asarray(every.geoms)
    dim = np.concatenate([np.zeros(0, int), *dims])
    return contact_of(every.distance, every.point, every.frame, every.parameters, geoms, dim)


def _group_contacts(
    found: Collisions, m: mjx.Model, d: mjx.Data, group: GeomPairs, pair: ContactPair | None
) -> _Contacts:
    parameters, geoms = contact_parameters(found.mj, m, group), group.geoms
    num, most = len(geoms), found.max_geom_pairs
    most = num if most is None or _ENDLESS & {*group.kinds} else most
    if pair is None:
        contact = listed_collisions(with_one_group(m, group), d)
        met = contact.dist, contact.pos, contact.frame
        if num > most:
            numbers = contact.includemargin  # see with_one_group
            return _Contacts(*met, jax.tree.map(lambda a: a[numbers], parameters), contact.geom)
    else:
        if num > most:
            nearest = _nearest(most, m, d, geoms)
            geoms, parameters = jax.tree.map(lambda a: a[nearest], (jnp.asarray(geoms), parameters))
        first, second = (Geom(d.geom_xpos[g], d.geom_xmat[g], m.geom_size[g]) for g in geoms.T)
        met = find(pair, first, second)
    return _Contacts(*met, *_repeated(len(met[0]) // len(geoms), (parameters, geoms)))


def _nearest(num: int, m: mjx.Model, d: mjx.Data, geoms: np.ndarray) -> Array:
    """Indices of the pairs with the nearest bounding spheres, shape (num,)."""
    center, other_center = d.geom_xpos[geoms.T]
    radius, other_radius = m.geom_rbound[geoms.T]
    distance = jax.vmap(jnp.linalg.norm)(other_center - center) - (radius + other_radius)
    return jax.lax.top_k(-distance, k=num)[1]


def _bounding_radii(mj: mujoco.MjModel, m: mjx.Model) -> Array:
    """Radii of the geoms' bounding spheres [m], shape (num_geoms,), also for sizes that are traced or were replaced."""
    sizes = jax.lax.stop_gradient(m.geom_size)  # they only order the pairs
    x, y, z = sizes.T
    by_kind = {
        mujoco.mjtGeom.mjGEOM_SPHERE: x,
        mujoco.mjtGeom.mjGEOM_CAPSULE: x + y,
        mujoco.mjtGeom.mjGEOM_CYLINDER: jnp.hypot(x, y),
        mujoco.mjtGeom.mjGEOM_BOX: jnp.sqrt(x * x + y * y + z * z),
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: sizes.max(axis=1),
    }
    kinds = np.asarray(mj.geom_type)
    return jnp.select([kinds == kind for kind in by_kind], list(by_kind.values()), jnp.asarray(m.geom_rbound))


def _deepest(num: int, parts: list[_Contacts]) -> _Contacts:
    every = _joined(parts)
    if len(every.distance) <= num:
        return every
    chosen = jax.lax.top_k(-every.distance, k=num)[1]
    return jax.tree.map(lambda a: jnp.asarray(a)[chosen], every)


def _repeated(num: int, tree: Any) -> Any:
    """Repeats each row ``num`` times, once per contact of a pair of geoms."""

    def rows(a: Array | np.ndarray) -> Array | np.ndarray:
        return (np if isinstance(a, np.ndarray) else jnp).repeat(a, num, axis=0)

    return jax.tree.map(rows, tree) if num > 1 else tree


def _joined(parts: list[_Contacts]) -> _Contacts:
    def rows(*arrays: Array | np.ndarray) -> Array | np.ndarray:
        constant = all(isinstance(a, np.ndarray) for a in arrays)
        return np.concatenate(arrays) if constant else jnp.concatenate([jnp.asarray(a) for a in arrays])

    return jax.tree.map(rows, *parts) if len(parts) > 1 else parts[0]


def _none(dtype: Any) -> _Contacts:
    scalar, pair, vector, five, matrix = (jnp.zeros((0, *shape), dtype) for shape in ((), (2,), (3,), (5,), (3, 3)))
    return _Contacts(scalar, vector, matrix, ContactParameters(scalar, five, pair, pair, five), np.zeros((0, 2), int))


__all__ = ["Collisions", "collide", "collisions"]
