"""User-defined contact functions: each computes the contacts between geoms of two kinds."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.arguments import check_integer
from rewax.physics.numerics.checks import shown
from rewax.physics.rigid.small_products import cross
from rewax.types import Array

KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box")
"""Supported kinds of geoms, in MuJoCo's order. Position, rotation and size describe each of them fully."""
NO_CONTACT = 1.0
"""Distance [m] that marks an unused contact slot, as in MJX (MuJoCo's JAX implementation)."""


class Geom(NamedTuple):
    """One geom of a model.

    Attributes:
      position: its center [m], shape (3,).
      rotation: from its frame to the world's, shape (3, 3). The normal of a plane and the axis of a capsule or cylinder
        are the frame's z axis, ``rotation[:, 2]``.
      size: MuJoCo's ``geom_size`` [m], shape (3,): radius of a sphere; radius and half length of a capsule or cylinder;
        half sizes of a box; semi-axes of an ellipsoid. Unused entries are 0.
    """

    position: Array
    rotation: Array
    size: Array


@dataclasses.dataclass(frozen=True)
class ContactPair:
    """The contact function for geoms of two kinds. Pass it to ``load`` in ``contact_pairs``.

    Attributes:
      kinds: the two geoms' kinds by their names in MJCF, in MuJoCo's order: plane, sphere, capsule, ellipsoid,
        cylinder, box.
      num_contacts: number n of contact slots for one pair of geoms.
      function: ``function(first, second)``, a pure JAX function of two ``Geom``s. It returns three arrays: distance,
        point and normal. Distance is the signed distance between the surfaces [m], shape (n,); it is negative where
        they overlap, and 1 in an unused slot. Point lies halfway between the surfaces [m], shape (n, 3). Normal is the
        unit normal from the first geom to the second, shape (n, 3), or (3,) if all contacts share one. Instead of
        normals, the function may return contact frames, shape (n, 3, 3), with rows normal and two directions of
        friction. For ``num_contacts=1``, distance and point may omit the axis of length n. rewax maps the function over
        all pairs of geoms of the model. Models with the same function share compiled programs.

    Raises:
      ValueError: a kind is unknown, the kinds are not in MuJoCo's order, both are planes, ``num_contacts`` is not a
        positive integer, or ``function`` is not callable.

    Gradient: that of the function, with respect to positions, rotations and sizes.

    Example:
      >>> def spheres(first, second):
      ...     across = second.position - first.position
      ...     length = jnp.sqrt(jnp.sum(across**2))
      ...     distance, normal = length - first.size[0] - second.size[0], across / length
      ...     return distance, first.position + normal * (first.size[0] + 0.5 * distance), normal
      >>> pair = ContactPair(("sphere", "sphere"), 1, spheres)
      >>> model = rigid.load("balls.xml", contact_pairs=(pair,))  # doctest: +SKIP
    """

    kinds: tuple[str, str]
    num_contacts: int
    function: Callable[[Geom, Geom], tuple[Array, Array, Array]]

    def __post_init__(self) -> None:
        kinds = tuple(self.kinds) if isinstance(self.kinds, (tuple, list)) else self.kinds
        if not isinstance(kinds, tuple) or len(kinds) != 2 or not all(kind in KINDS for kind in kinds):
            raise ValueError(f"kinds is {shown(self.kinds)}: give two of {', '.join(map(repr, KINDS))}")
        if kinds == ("plane", "plane"):
            raise ValueError("kinds is ('plane', 'plane'), which never touch: give another kind beside plane")
        if KINDS.index(kinds[0]) > KINDS.index(kinds[1]):
            raise ValueError(f"kinds is {self.kinds!r}: give {kinds[::-1]!r}, MuJoCo's order, and a function of these")
        object.__setattr__(self, "kinds", kinds)
        check_integer(f"num_contacts of {self}", self.num_contacts, 1)
        if not callable(self.function):
            raise ValueError(f"function of {self} is {shown(self.function)}: give a function of two geoms")

    def __str__(self) -> str:
        return f"the contact pair {self.kinds[0]}-{self.kinds[1]}"


def find(pair: ContactPair, first: Geom, second: Geom) -> tuple[Array, Array, Array]:
    """Compute the contacts of n pairs of geoms. Contacts of one pair are consecutive.

    Args:
      pair: the contact function, with k contacts per pair.
      first, second: the geoms; each array has a leading axis of length n.

    Returns:
      Distances [m], shape (n k,); points [m], shape (n k, 3); frames, shape (n k, 3, 3).

    Raises:
      ValueError: the pair's function does not return what ``ContactPair`` requires.

    Gradient: that of the pair's function. Where it returns normals, the friction directions have the gradient of
    ``contact_frame``.
    """
    num, dtype = pair.num_contacts, first.position.dtype

    def one(first: Geom, second: Geom) -> tuple[Array, Array, Array]:
        result = pair.function(first, second)
        _check_result(pair, result)
        distance, point, normal = map(jnp.asarray, result)
        return distance.astype(dtype).reshape(num), point.astype(dtype).reshape(num, 3), normal.astype(dtype)

    distance, point, normal = jax.vmap(one)(first, second)
    if normal.ndim == 2:
        frame = contact_frame(normal)
        frame = jnp.repeat(frame, num, axis=0) if num > 1 else frame
    else:
        frame = normal if normal.ndim == 4 else contact_frame(normal)
    return distance.reshape(-1), point.reshape(-1, 3), frame.reshape(-1, 3, 3)


def contact_frame(normal: Array) -> Array:
    """MuJoCo's right-handed contact frame: the rows are the normal and two tangents. (..., 3) -> (..., 3, 3).

    The first tangent is the y axis projected onto the contact plane, or the z axis where abs(normal[1]) >= 0.5.

    Gradient: exact, except where the first tangent switches between y and z.
    """
    level = (normal[..., 1] > -0.5) & (normal[..., 1] < 0.5)
    start = jnp.where(level[..., None], jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    tangent = start - normal * jnp.sum(start * normal, axis=-1, keepdims=True)
    tangent = tangent / jnp.sqrt(jnp.sum(tangent * tangent, axis=-1, keepdims=True))
    return jnp.stack([normal, tangent, cross(normal, tangent)], axis=-2)


def check_contact_pairs(pairs: Sequence[ContactPair]) -> None:
    """Raises a ValueError for entries that are not contact pairs, repeated kinds, and functions with wrong results."""
    for i, pair in enumerate(pairs):
        if not isinstance(pair, ContactPair):
            raise ValueError(f"contact_pairs holds {pair!r}: give rigid.ContactPair(kinds, num_contacts, function)")
        if any(pair.kinds == other.kinds for other in pairs[:i]):
            raise ValueError(f"contact_pairs holds {str(pair)[4:]} twice: leave one out")
        _check_result(pair, _traced(pair))


def _traced(pair: ContactPair) -> Any:
    """The traced result of a pair's function, for abstract geoms."""
    geom = jax.eval_shape(lambda: Geom(jnp.zeros(3), jnp.zeros((3, 3)), jnp.zeros(3)))
    results: list[Any] = []
    try:
        jax.eval_shape(lambda first, second: results.append(pair.function(first, second)), geom, geom)
    except Exception as error:  # of any type: it comes from a user's function
        reason = " ".join(str(error).partition("\n")[0].split())
        raise ValueError(
            f"the function of {pair} cannot be traced ({type(error).__name__}: {reason}): give a pure JAX function"
        ) from error
    return results[0]


def _check_result(pair: ContactPair, result: Any) -> None:
    """Raises a ValueError unless a pair's function returned three floating-point arrays of the right shapes."""
    if not isinstance(result, (tuple, list)) or len(result) != 3:
        what = "one array" if isinstance(result, jax.Array) else shown(result)
        raise ValueError(f"the function of {pair} returned {what}: return distance, point and normal")
    num = pair.num_contacts
    legal = {
        "distance": [(num,)] + [()] * (num == 1),
        "point": [(num, 3)] + [(3,)] * (num == 1),
        "normal": [(num, 3), (3,), (num, 3, 3)],
    }
    for array, (name, shapes) in zip(result, legal.items(), strict=True):
        if not isinstance(array, (jax.Array, np.ndarray, np.generic, float, int)):
            raise ValueError(f"the function of {pair} returned {shown(array)} as {name}: return an array")
        if jnp.shape(array) not in shapes:
            wanted = ", or ".join(map(str, shapes))
            raise ValueError(
                f"the function of {pair} returned a {name} of shape {jnp.shape(array)}: return shape {wanted}, for "
                f"num_contacts={num}"
            )
        if not jnp.issubdtype(jnp.result_type(array), jnp.floating):
            raise ValueError(
                f"the function of {pair} returned a {name} of dtype {jnp.result_type(array)}: return floats"
            )


__all__ = ["KINDS", "NO_CONTACT", "ContactPair", "Geom", "check_contact_pairs", "contact_frame", "find"]
