"""The check of a contact pair: distances, points, normals and derivatives of geoms that touch and that do not."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.rigid import ContactPair, Geom
from rewax.physics.rigid.contact_pair import NO_CONTACT, check_contact_pairs, find
from rewax.testing.touching_geoms import Touching, distance_to, stacked, touching
from rewax.types import Array
from rewax.xla_options import unoptimised

_DEPTH, _FAR = 1e-3, 0.5
"""Overlap or gap of geoms of 0.1 m, and the distance of geoms that are far apart [m]."""
_STEP = 1e-6
"""Step of central differences [m]."""


def check_contact_pair(pair: ContactPair, *, seed: int = 0, num_states: int = 64, tolerance: float = 1e-3) -> None:
    """Check the function of a contact pair against the protocol of ``rewax.physics.rigid.ContactPair``.

    The check runs in float64. It draws geoms of about 0.1 m with random sizes and poses, which overlap by 1 mm, are
    1 mm apart or are far apart. Further geoms stand or lie exactly on each other. It checks that

    - the function returns arrays of the right shapes, and frames are orthonormal;
    - a distance is negative if and only if the geoms overlap, and the smallest is minus the depth of the overlap;
    - the normal of the deepest contact is the derivative of the distance with respect to the position of the second
      geom, both by finite differences and by ``jax.grad``;
    - the point of each contact is at most half the distance away from both surfaces, its normal is not opposite to that
      of the deepest one, and no two contacts are at one place;
    - derivatives with respect to positions, rotations and sizes are finite.

    Slots without contact are not checked, except for finite numbers.

    Args:
      pair: the contact pair.
      seed: seed of the random geoms.
      num_states: number of pairs of geoms for each distance.
      tolerance: of lengths, relative to 1 mm, and of normals. Iterative functions need a larger one.

    Raises:
      AssertionError: a sentence that names what is wrong, and what helps.
      ValueError: the function returns something of another shape, or num_states is below 1.

    Example:
      >>> check_contact_pair(rigid.ContactPair(("sphere", "sphere"), 1, spheres))  # doctest: +SKIP
    """
    if num_states < 1:
        raise ValueError(f"num_states is {num_states}: use 1 or more")
    check_contact_pairs([pair])
    with jax.enable_x64(True):
        gaps = np.repeat([-_DEPTH, _DEPTH, _FAR], num_states)
        keys = jax.random.split(jax.random.key(seed), len(gaps))
        drawn = _compiled(lambda key, gap: touching(key, pair.kinds, gap))(keys, jnp.asarray(gaps))
        lies = [(one, other) for one in (False, True) for other in (False, True)]
        exact = [stacked(pair.kinds, lie, gap) for lie in lies for gap in (-_DEPTH, _DEPTH)]
        states = jax.tree.map(lambda many, *few: jnp.concatenate([many, jnp.stack(few)]), drawn, *exact)
        _check_derivatives(pair, states)
        found = _measured(pair, states)
    found = _Measured(*(a[: len(gaps)] for a in found))
    _check_frames(pair, found, tolerance)
    _check_signs(pair, found, gaps, tolerance)
    _check_deepest(pair, _Measured(*(a[gaps < 0] for a in found)), tolerance)


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``jit`` of ``vmap`` of a function, without optimisation: the program runs once."""
    return jax.jit(jax.vmap(function), compiler_options=unoptimised())


def _contacts(pair: ContactPair, first: Geom, second: Geom) -> tuple[Array, Array, Array]:
    """Contacts of two geoms: distances, points and frames."""
    return find(pair, *jax.tree.map(lambda a: a[None], (first, second)))


class _Measured(NamedTuple):
    """Results for a pair of geoms with k slots for contacts; arrays may have a leading axis of pairs."""

    distance: np.ndarray
    """Distances of the contacts [m], shape (k,)."""
    frame: np.ndarray
    """Frames of the contacts, shape (k, 3, 3)."""
    point: np.ndarray
    """Places of the contacts [m], shape (k, 3)."""
    off: np.ndarray
    """Distances of the contact points from both surfaces [m], shape (2, k)."""
    slope: np.ndarray
    """Derivative of the smallest distance with respect to the second geom's position by central differences, (3,)."""
    gradient: np.ndarray
    """The same derivative by ``jax.grad``, shape (3,)."""


def _measured(pair: ContactPair, states: Touching) -> _Measured:
    def one(state: Touching) -> tuple[Array, ...]:
        distance, point, frame = _contacts(pair, state.first, state.second)
        geoms = zip(pair.kinds, (state.first, state.second), strict=True)
        off = [jax.vmap(lambda p, kind=kind, geom=geom: distance_to(kind, geom, p))(point) for kind, geom in geoms]

        def moved(shift: Array) -> Array:
            second = state.second._replace(position=state.second.position + shift)
            return jnp.min(_contacts(pair, state.first, second)[0])

        ends = jax.vmap(moved)(_STEP * jnp.concatenate([jnp.eye(3), -jnp.eye(3)]))
        slope = (ends[:3] - ends[3:]) / (2.0 * _STEP)
        return distance, frame, point, jnp.abs(jnp.stack(off)), slope, jax.grad(moved)(jnp.zeros(3))

    return _Measured(*map(np.asarray, _compiled(one)(states)))


def _check_frames(pair: ContactPair, found: _Measured, tolerance: float) -> None:
    is_contact = found.distance < NO_CONTACT
    length = np.linalg.norm(found.frame[:, :, 0], axis=-1)
    wrong = is_contact & ~(np.abs(length - 1.0) < tolerance)
    assert not wrong.any(), f"the function of {pair} returns a normal of length {length[wrong][0]:.3g}: make it 1"
    product = np.einsum("...ij,...kj->...ik", found.frame, found.frame) - np.eye(3)
    wrong = is_contact & ~(np.abs(product).max(axis=(-1, -2)) < tolerance)
    assert not wrong.any(), (
        f"the function of {pair} returns a frame whose rows are not of length 1 and perpendicular: make them so, or "
        "return normals"
    )


def _check_signs(pair: ContactPair, found: _Measured, gaps: np.ndarray, tolerance: float) -> None:
    least = found.distance.min(axis=1)
    wrong = np.where(gaps < 0, np.abs(least - gaps) > tolerance * _DEPTH, least < 0)
    if wrong.any():
        state = np.flatnonzero(wrong)[0]
        raise AssertionError(
            f"the function of {pair} returns {least[state]:.3g} as the smallest distance of geoms that "
            f"{'overlap by' if gaps[state] < 0 else 'are apart by'} {abs(gaps[state])} m: a distance is negative where "
            "geoms overlap, by how far one must move to be free, and positive where they do not"
        )


def _check_deepest(pair: ContactPair, found: _Measured, tolerance: float) -> None:
    """Checks the normal of the deepest contact of each pair that overlaps, and normals and points of all contacts."""
    rows, deepest = np.arange(len(found.distance)), np.argmin(found.distance, axis=1)
    normal = found.frame[rows, deepest, 0]
    for slope, name in ((found.slope, "a central difference"), (found.gradient, "jax.grad")):
        wrong = ~(np.abs(slope - normal).max(axis=1) < tolerance)
        if wrong.any():
            one, other = (_numbers(vectors[np.argmax(wrong)]) for vectors in (normal, slope))
            raise AssertionError(
                f"the function of {pair} returns the normal {one}, but the distance changes by {other} as the second "
                f"geom moves ({name}): the normal points from the first geom to the second, and is that derivative"
            )
    is_contact, half = found.distance < 0, 0.5 * np.abs(found.distance)
    for kind, off in zip(pair.kinds, np.moveaxis(found.off, 1, 0), strict=True):
        wrong = is_contact & ~(off < half + tolerance * _DEPTH)
        assert not wrong.any(), (
            f"the function of {pair} returns a point that is {off[wrong][0]:.3g} m from the surface of the {kind}, "
            f"where they overlap by {2.0 * half[wrong][0]:.3g} m: put points halfway between the two surfaces"
        )
    along = np.einsum("pki,pi->pk", found.frame[:, :, 0], normal)
    assert not (is_contact & (along <= 0)).any(), (
        f"the function of {pair} returns contacts of two geoms with opposite normals: all point from the first geom to "
        "the second"
    )
    apart = np.linalg.norm(found.point[:, :, None] - found.point[:, None], axis=-1)
    twice = is_contact[:, :, None] & is_contact[:, None] & (apart < tolerance * _DEPTH)
    twice &= ~np.eye(found.distance.shape[1], dtype=bool)
    assert not twice.any(), (
        f"the function of {pair} returns the same contact in two slots, which doubles its force: give unused slots a "
        "positive distance"
    )


def _check_derivatives(pair: ContactPair, states: Touching) -> None:
    """Checks that values and derivatives are finite."""

    def values(first: Geom, second: Geom) -> dict[str, Array]:
        return dict(zip(("distance", "point", "frame"), _contacts(pair, first, second), strict=True))

    def one(state: Touching) -> tuple[dict[str, Array], dict[str, tuple[Geom, Geom]]]:
        geoms = state.first, state.second
        return values(*geoms), jax.jacrev(values, argnums=(0, 1))(*geoms)

    found, slopes = _compiled(one)(states)
    for name, value in found.items():
        assert np.isfinite(value).all(), f"the function of {pair} returns a {name} that is not finite"
    for name, geoms in slopes.items():
        for kind, geom in zip(("first", "second"), geoms, strict=True):
            for field, slope in geom._asdict().items():
                assert np.isfinite(slope).all(), (
                    f"the derivative of the {name} with respect to the {field} of the {kind} geom is not finite, for "
                    f"{pair}: a root, a norm or a division at 0 does it, in the branch of a jnp.where that is "
                    "not taken too"
                )


def _numbers(vector: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in vector) + ")"


__all__ = ["check_contact_pair"]
