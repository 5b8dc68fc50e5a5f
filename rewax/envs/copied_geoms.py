"""Geoms of a robot and the colliders made of them: a change of the geoms alone does not reach the soft body."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jax.core import Tracer

from rewax.physics.contact import Collider
from rewax.types import Array

if TYPE_CHECKING:  # it imports mujoco, which tasks without a robot do not need
    from rewax.physics.rigid import RigidModel

_PARTS = {"geom_friction": "friction", "geom_size": "shape", "geom_pos": "offset", "geom_quat": "rotation"}
"""Parameters of geoms, and the part of a collider that ``rigid.colliders`` makes of each."""


def check_colliders(old: Any, new: Any) -> None:
    """Compare an environment with a changed one.

    ``rigid.colliders`` copies geoms into the colliders of a scene. The soft body touches the copies, so a change of the
    geoms alone would leave it as it was, with a gradient of zero. A collider is a copy if it has a geom's body, place
    and size. Traced parameters are not compared.

    Args:
      old: an environment.
      new: of the same structure.

    Raises:
      ValueError: a geom changed, but not the collider that is its copy.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((old, new))):
        return
    before, after = (getattr(env, "unwrapped", env) for env in (old, new))
    colliders = _colliders(before)
    for name, model in _robots(before) if colliders else ():
        changed = getattr(after, name).parameters
        for part, geom in _changed_geoms(model.parameters, changed):
            for i in _copies(colliders, model, geom):
                one, other = (getattr(of[i], _PARTS[part]) for of in (colliders, _colliders(after)))
                if any(a is b for a, b in zip(jax.tree.leaves(one)[:1], jax.tree.leaves(other)[:1], strict=True)):
                    raise ValueError(
                        f"{name}.parameters[{part}] of geom {geom} is changed, but not its copy "
                        f"scene.colliders[{i}].{_PARTS[part]}, which touches the soft body: change both, or make the "
                        "scene's colliders anew with rigid.colliders"
                    )


def _colliders(env: Any) -> tuple[Collider, ...]:
    return getattr(getattr(env, "scene", None), "colliders", ())


def _robots(env: Any) -> Iterator[tuple[str, "RigidModel"]]:
    return ((name, value) for name, value in vars(env).items() if _PARTS.keys() <= _parameters(value).keys())


def _parameters(value: Any) -> dict[str, Array]:
    parameters = getattr(value, "parameters", None)
    return parameters if isinstance(parameters, dict) else {}


def _changed_geoms(old: dict[str, Array], new: dict[str, Array]) -> Iterator[tuple[str, int]]:
    """The changed parameters of geoms, and the geoms; of friction the first coefficient alone."""
    for part in _PARTS:
        if old[part] is new[part]:
            continue
        differs = np.asarray(old[part]) != np.asarray(new[part])
        own = differs[:, :1] if part == "geom_friction" else differs
        yield from ((part, int(geom)) for geom in np.flatnonzero(own.any(axis=1)))


def _copies(colliders: tuple[Collider, ...], model: "RigidModel", geom: int) -> Iterator[int]:
    """Indices of the colliders with the body, the place and the size of a geom."""
    size, place = (np.asarray(model.parameters[name])[geom] for name in ("geom_size", "geom_pos"))
    for i, collider in enumerate(colliders):
        lengths = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(collider.shape)] or [np.zeros(0)])
        same_size = np.array_equal(lengths, size[: lengths.size])
        if collider.body == model.static.mj.geom_bodyid[geom] and same_size and np.array_equal(collider.offset, place):
            yield i


__all__ = ["check_colliders"]
