"""Models that rewax passes to MJX, restricted to the contacts that MJX has to find."""

# pyright: reportAttributeAccessIssue=false

import copy
from collections.abc import Sequence

import numpy as np

from rewax.physics.rigid import mjcf
from rewax.physics.rigid.geom_pairs import GeomPairs, kind
from rewax.physics.rigid.mjx_access import mjx, mujoco


def with_groups_that_touch(mj: mujoco.MjModel, groups: Sequence[GeomPairs]) -> mujoco.MjModel:
    """A copy of a model for ``mjx.put_model`` in which only geoms of the kinds of these groups touch.

    ``put_model`` refuses kinds that MJX cannot collide and meshes with a margin, and prepares meshes that may touch.
    In the copy more geoms of the same kinds may touch than in the model.
    """
    mj = copy.copy(mj)
    pairs = [(group.kinds, group.geoms[group.listed < 0]) for group in groups]
    kinds = {names for names, geoms in pairs if len(geoms)}
    bits = {name: 1 << i for i, name in enumerate(sorted({name for names in kinds for name in names}))}
    mj.geom_contype[:] = mj.geom_conaffinity[:] = 0
    for geom in {int(geom) for _, geoms in pairs for geom in geoms.ravel()}:
        name = kind(mj, geom)
        mj.geom_contype[geom] = bits[name]
        mj.geom_conaffinity[geom] = sum({bits[other] for first, other in kinds if first == name})
    with_meshes = {int(geom) for names, geoms in pairs if {"mesh", "hfield"} & {*names} for geom in geoms.ravel()}
    mj.geom_margin[np.setdiff1d(np.arange(mj.ngeom), [*with_meshes])] = 0.0
    listed = {int(pair) for group in groups for pair in group.listed}
    for pair in set(range(mj.npair)) - listed:
        # A pair cannot be removed from a compiled model. But MJX can collide two geoms of one kind other than plane.
        geoms = int(mj.pair_geom1[pair]), int(mj.pair_geom2[pair])
        mj.pair_geom1[pair] = mj.pair_geom2[pair] = max(geoms, key=lambda geom: int(mj.geom_type[geom]))
    return mj


def without_contacts(mj: mujoco.MjModel, m: mjx.Model) -> mjx.Model:
    """MJX's model without contacts and without a limit of their number."""
    none, numbers = np.zeros_like(m.geom_contype), np.array(m.numeric_data)
    numbers[mjcf.numeric(mj, "max_contact_points")] = -1
    return m.replace(npair=0, geom_contype=none, geom_conaffinity=none, numeric_data=numbers)


def with_one_group(m: mjx.Model, group: GeomPairs) -> mjx.Model:
    """A model without other contacts, with the pairs of a group as its explicit pairs.

    MJX only copies a pair's margin to its contacts. So here the margin is the pair's index in the group, which tells
    whose contacts they are if MJX leaves pairs out.
    """
    num = len(group.geoms)
    sizes = {"friction": 5, "solref": mujoco.mjNREF, "solreffriction": mujoco.mjNREF, "solimp": mujoco.mjNIMP}
    unused = {f"pair_{name}": np.zeros((num, size), m.geom_size.dtype) for name, size in sizes.items()}
    return m.replace(
        npair=num, pair_geom1=group.geoms[:, 0], pair_geom2=group.geoms[:, 1], pair_dim=np.full(num, group.condim),
        pair_margin=np.arange(num), **unused,
    )  # fmt: skip


__all__ = ["with_groups_that_touch", "with_one_group", "without_contacts"]
