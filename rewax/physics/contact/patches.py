"""Patches of bodies that feel contact: sums of the impulses that bodies receive at points, by the nearest patch."""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.lowering.fusion import compute_once
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, Number, check_numbers
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose, turned
from rewax.types import Array, Scalar, Vector

T = TypeVar("T")

WALLS = -1
"""The body of walls and ground. Its frame is the world's."""


class Wrench(NamedTuple):
    """Force [N] and torque about the body's origin [N m] on each body or patch, shapes (n, 3)."""

    force: Array
    torque: Array


@struct.dataclass
class Patches(struct.Replaceable):
    """Parts of bodies that feel contact. A body's patch feels the contact points that are nearest to its center.

    Attributes:
      body: the body of each patch, an index, or ``WALLS`` (static).
      center: in the frame of the patch's body [m], shape (num_patches, 3). None: each body has one patch.

    Raises:
      ValueError: no body, an index that is no integer, several patches of one body without ``center``, or a ``center``
        of another shape.
    """

    body: tuple[int, ...] = struct.static_field()
    center: Vector | None = struct.number(FINITE, "give points in metres", shape=("num_patches", 3), default=None)

    def __post_init__(self) -> None:
        whole = all(isinstance(one, (int, np.integer)) and not isinstance(one, bool) for one in self.body)
        if not self.body or not whole:
            raise ValueError(f"body is {self.body}: give at least one index of a body, an integer, or WALLS")
        if self.center is None and len(set(self.body)) < len(self.body):
            raise ValueError(f"body is {self.body}, with several patches of one body: give center, a point for each")
        if self.center is not None:
            check_numbers([Number("center", self.center, FINITE, "give points in metres", (len(self.body), 3))])

    @property
    def splits(self) -> bool:
        """Whether a body has several patches."""
        return len(set(self.body)) < len(self.body)


def check_patches(patches: Any, num_bodies: int) -> None:
    """Raises ValueError if a patch belongs to no body. ``patches`` may be a tree of ``Patches``."""
    for one in jax.tree.leaves(patches, is_leaf=_is_patches):
        if not _is_patches(one):
            raise ValueError(f"patches holds {one!r}: give Patches(body=...), or a dict of them")
        for body in one.body:
            if not WALLS <= body < num_bodies:
                raise ValueError(
                    f"a patch belongs to body {body}, but there are {num_bodies} bodies: give an index from 0 to "
                    f"{num_bodies - 1}, or {WALLS} for walls and ground"
                )


def feels_walls(patches: Any) -> bool:
    """Whether a patch of a tree of ``Patches`` belongs to walls and ground."""
    return any(WALLS in one.body for one in jax.tree.leaves(patches, is_leaf=_is_patches))


def no_touch(patches: Any, like: Array) -> Any:
    """Zero force and torque on each patch of a tree of ``Patches``; ``like`` sets dtype and mesh axes, as in
    ``coupling.no_wrench``."""

    def one(patches: Patches) -> Wrench:
        zeros = jnp.zeros_like(like, shape=(len(patches.body), 3))
        return Wrench(zeros, jnp.zeros_like(zeros))

    return jax.tree.map(one, patches, is_leaf=_is_patches)


def felt(
    patches: Any,
    position: Vec3,
    received: Sequence[tuple[int | Array, Vec3]],
    bodies: Pose,
    *,
    turned_by: Sequence[tuple[int | Array, Vec3]] = (),
) -> Any:
    """Sums over contact points of the impulses on each patch, and of their moments about the body's origin.

    Args:
      patches: ``Patches``, or a tree of them.
      position: contact points in the world [m], components of shape (num_points,).
      received: pairs of a body and the impulses [N s] that it receives at the points, components of shape
        (num_points,). The body is an index, ``WALLS``, or an array of indices of shape () or (num_points,). With forces
        instead of impulses the results are forces and torques.
      bodies: poses of all bodies, shapes (num_bodies, 3), (num_bodies, 3, 3).
      turned_by: pairs of a body and angular impulses [N m s] at the points, beside those of ``received``.

    Returns:
      A ``Wrench`` for each ``Patches``, in the same tree; (num_patches, 3) each.

    Gradient: exact by impulses, positions and poses. None by which patch is nearest.
    """
    return jax.tree.map(lambda one: _felt(one, position, received, bodies, turned_by), patches, is_leaf=_is_patches)


def accumulated(total: T, impulse: T, weight: Scalar = 1.0) -> T:
    """``total + weight * impulse`` of two trees of one structure."""
    return jax.tree.map(lambda a, b: a + weight * b, total, impulse)


def _is_patches(tree: Any) -> bool:
    return isinstance(tree, Patches)


def _felt(patches: Patches, position: Vec3, received: Any, bodies: Pose, turned_by: Any) -> Wrench:
    dtype = position[0].dtype
    owner = np.asarray(patches.body, int)
    # The last row, which the index of WALLS reads, is the world's frame.
    origin = jnp.concatenate([bodies.position, jnp.zeros((1, 3), dtype)])[owner]
    weight = None
    if patches.splits and patches.center is not None:
        rotation = jnp.concatenate([bodies.rotation, jnp.eye(3, dtype=dtype)[None]])[owner]
        weight = _shares(owner, position, origin + turned(rotation, patches.center.astype(dtype)))

    def by_patch(pairs: Sequence[tuple[int | Array, Vec3]]) -> Array:
        """Shape (num_patches, 3, num_points)."""
        sums = {body: _of_body(body, pairs, position[0]) for body in set(patches.body)}
        each = jnp.stack([sums[body] for body in patches.body])
        return each if weight is None else weight[:, None] * each

    # Moments about a common point near the bodies are one matrix product for all of them.
    about = jax.lax.stop_gradient(jnp.mean(origin, axis=0))
    arms = jnp.stack([jnp.ones_like(position[0]), *(position[i] - about[i] for i in cp.AXES)])
    moments = jnp.einsum("pin,jn->pij", by_patch(received), arms, precision="highest")
    impulse = moments[..., 0]
    after, last = (np.arange(3) + 1) % 3, (np.arange(3) + 2) % 3
    turning = moments[:, last, 1 + after] - moments[:, after, 1 + last]
    turning = turning - jnp.cross(origin - about, impulse)
    return Wrench(impulse, turning + jnp.sum(by_patch(turned_by), axis=-1) if turned_by else turning)


def _of_body(body: int, pairs: Sequence[tuple[int | Array, Vec3]], like: Array) -> Array:
    """Force or impulse on a body at each point, shape (3, num_points)."""
    total = [jnp.zeros_like(like)] * 3
    for owner, vector in pairs:
        if isinstance(owner, int):
            if owner == body:
                total = [a + b for a, b in zip(total, vector, strict=True)]
        else:
            total = [a + jnp.where(owner == body, b, 0.0) for a, b in zip(total, vector, strict=True)]
    return jnp.stack(total)


def _shares(owner: np.ndarray, position: Vec3, center: Array) -> Array:
    """1 where a patch is the nearest of its body's, else 0, shape (num_patches, num_points)."""
    center, position = jax.lax.stop_gradient((center, position))
    # Computed once: fused copies may round differently, and a point would be felt twice or not at all.
    square: Any = compute_once(sum((position[i] - center[:, i, None]) ** 2 for i in cp.AXES))
    shares: list[Any] = [None] * len(owner)
    for body in np.unique(owner):
        own = np.flatnonzero(owner == body)
        nearest = jnp.argmin(square[own], axis=0)
        for k, patch in enumerate(own):
            shares[patch] = (nearest == k).astype(square.dtype)
    return jnp.stack(shares)


__all__ = ["WALLS", "Patches", "Wrench", "accumulated", "check_patches", "feels_walls", "felt", "no_touch"]
