"""Pairs of geoms that may touch: explicit pairs, and pairs that contact masks and the tree of bodies permit."""

# pyright: reportAttributeAccessIssue=false

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np

from rewax.physics.rigid.mjcf import is_disabled


class GeomPairs(NamedTuple):
    """n pairs of geoms with the same kinds, meshes and condim.

    Groups, and the pairs within a group, are in MJX's order. So contacts and constraint rows are in MJX's order too.
    """

    kinds: tuple[str, str]
    """Kinds of the two geoms, by their names in MJCF, in MuJoCo's order."""
    condim: int
    """Dimensions of the contact force: 1, 3, 4 or 6."""
    geoms: np.ndarray
    """Ids of the geoms, shape (n, 2)."""
    listed: np.ndarray
    """Id of the explicit pair, or -1 if there is none, shape (n,). Explicit pairs come first."""


def geom_pairs(mj: mujoco.MjModel, listed: np.ndarray) -> tuple[GeomPairs, ...]:
    """Pairs of geoms that may touch, in groups.

    Args:
      mj: the model.
      listed: ids of the explicit pairs to include, shape (m,).

    Source: MuJoCo MJX 3.17, ``collision_driver.geom_pairs`` and ``_geom_groups``.
    """
    groups: dict[tuple, list[tuple[int, int, int]]] = {}
    if is_disabled(mj, "CONTACT"):
        return ()
    for first, second, pair in _pairs(mj, listed):
        groups.setdefault(_key(mj, first, second, pair), []).append((first, second, pair))
    return tuple(
        GeomPairs(kinds, condim, np.array(pairs)[:, :2], np.array(pairs)[:, 2])
        for (kinds, condim, *_), pairs in groups.items()
    )


def kind(mj: mujoco.MjModel, geom: int) -> str:
    """A geom's kind by its name in MJCF."""
    return mujoco.mjtGeom(mj.geom_type[geom]).name.removeprefix("mjGEOM_").lower()


def _key(mj: mujoco.MjModel, first: int, second: int, pair: int) -> tuple:
    """Key of a group: all its pairs have the same."""
    if pair >= 0:
        condim = mj.pair_dim[pair]
    else:
        priority = mj.geom_priority[first] - mj.geom_priority[second]
        condims = mj.geom_condim[first], mj.geom_condim[second]
        condim = max(condims) if priority == 0 else condims[0] if priority > 0 else condims[1]
    kinds, meshes = (kind(mj, first), kind(mj, second)), (mj.geom_dataid[first], mj.geom_dataid[second])
    return kinds, int(condim), *map(int, meshes), *_cells(mj, kinds[0], meshes[0], second)


def _cells(mj: mujoco.MjModel, first_kind: str, field: int, geom: int) -> tuple[int, ...]:
    """Number of cells of a height field that a geom can cover along x and y; () without a height field."""
    if first_kind != "hfield":
        return ()
    counts = mj.hfield_ncol[field], mj.hfield_nrow[field]
    cells = [2 * half / (count - 1) for half, count in zip(mj.hfield_size[field][:2], counts, strict=True)]
    reach = 2 * mj.geom_rbound[geom]
    return tuple(min(int(np.ceil(reach / c)) + 1, int(n)) for c, n in zip(cells, counts, strict=True))


def _pairs(mj: mujoco.MjModel, listed: np.ndarray) -> list[tuple[int, int, int]]:
    """Ids of two geoms, the lower kind first, and the id of their explicit pair, or -1."""
    found: set[tuple[int, int]] = set()
    pairs = []

    def ordered(first: int, second: int) -> tuple[int, int]:
        return (second, first) if mj.geom_type[first] > mj.geom_type[second] else (first, second)

    for pair in listed:
        geoms = ordered(int(mj.pair_geom1[pair]), int(mj.pair_geom2[pair]))
        found.add(geoms)
        pairs.append((*geoms, int(pair)))
    for first, second in _unfiltered_pairs(mj):
        geoms = ordered(first, second)
        if geoms not in found and _match(mj, *geoms):
            found.add(geoms)
            pairs.append((*geoms, -1))
    return pairs


def _unfiltered_pairs(mj: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Pairs of geoms with masks whose bodies are not excluded, nor welded together, nor parent and child."""
    has_mask = (mj.geom_contype | mj.geom_conaffinity) != 0
    geoms = {body: np.flatnonzero(has_mask & (mj.geom_bodyid == body)).tolist() for body in range(mj.nbody)}
    excluded, filters = set(mj.exclude_signature.tolist()), not is_disabled(mj, "FILTERPARENT")
    weld = mj.body_weldid.tolist()
    above = [weld[parent] for parent in mj.body_parentid[weld]]
    for body, other in itertools.combinations([body for body in geoms if geoms[body]], 2):
        related = weld[body] and weld[other] and (weld[body] == above[other] or weld[other] == above[body])
        if (body << 16) + other not in excluded and weld[body] != weld[other] and not (filters and related):
            yield from itertools.product(geoms[body], geoms[other])


def _match(mj: mujoco.MjModel, first: int, second: int) -> bool:
    """Whether the masks of two geoms permit a contact and their kinds can have one."""
    if kind(mj, first) == "plane" and kind(mj, second) in ("plane", "hfield"):
        return False
    types, affinities = mj.geom_contype, mj.geom_conaffinity
    return bool(types[first] & affinities[second] or types[second] & affinities[first])


__all__ = ["GeomPairs", "geom_pairs", "kind"]
