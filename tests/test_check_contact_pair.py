"""check_contact_pair passes sound pairs, of all kinds that it draws, and names what is wrong with a broken one."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.rigid import ContactPair
from rewax.testing import check_contact_pair
from rewax.testing.touching_geoms import distance_to, stacked, touching
from rewax.xla_options import unoptimised

KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box")


def spheres(first, second):
    across = second.position - first.position
    length = jnp.sqrt(jnp.sum(across**2))
    distance, normal = length - first.size[0] - second.size[0], across / length
    return distance, first.position + normal * (first.size[0] + 0.5 * distance), normal


def framed(first, second):
    """The same with directions of friction."""
    distance, point, normal = spheres(first, second)
    side = jnp.cross(normal, jnp.array([0.3, 0.5, 0.8]))
    side = side / jnp.sqrt(jnp.sum(side**2))
    return distance[None], point[None], jnp.stack([normal, side, jnp.cross(normal, side)])[None]


def with_slot(first, second):
    """A second slot that is never used, and whose other numbers mean nothing."""
    distance, point, normal = spheres(first, second)
    return jnp.stack([jnp.ones(()), distance]), jnp.stack([9 * point, point]), jnp.stack([9 * normal, normal])


@pytest.mark.parametrize(("function", "num"), [(spheres, 1), (framed, 1), (with_slot, 2)])
def test_sound_pairs_pass(function, num):
    check_contact_pair(ContactPair(("sphere", "sphere"), num, function), num_states=8)


def changed(**changes):
    """The pair with something of its results changed."""

    def function(first, second):
        found = dict(zip(("distance", "point", "normal"), spheres(first, second), strict=True))
        return tuple(changes.get(name, lambda x: x)(value) for name, value in found.items())

    return function


def shallow(first, second):
    """Distances that do not change as the normal says."""
    distance, point, normal = spheres(first, second)
    return (
        distance + 0.05 * jnp.where(distance < 0, second.position[0] - jax.lax.stop_gradient(second.position[0]), 0),
        point,
        normal,
    )


def rooted(first, second):
    distance, point, normal = spheres(first, second)
    return distance + 0 * jnp.sqrt(first.size[1]), point, normal


BROKEN = {
    "sign": (changed(distance=lambda d: -d), "as the smallest distance of geoms that overlap by 0.001 m: a distance is negative where"),
    "reach": (changed(distance=lambda d: d - 0.002), "as the smallest distance of geoms that overlap by 0.001 m"),
    "apart": (changed(distance=lambda d: jnp.where(d > 0.1, -1.0, d)), "returns -1 as the smallest distance of geoms that are apart by 0.5 m"),
    "normal": (changed(normal=lambda n: -n), "(a central difference): the normal points from the first geom to the second, and is that derivative"),
    "length": (changed(normal=lambda n: 2 * n), "returns a normal of length 2: make it 1"),
    "gradient": (shallow, "(jax.grad): the normal points from the first geom to the second, and is that derivative"),
    "point": (changed(point=lambda p: p + 0.01), "m from the surface of the sphere, where they overlap by 0.001 m: put points halfway between the two surfaces"),
    "root": (rooted, "the derivative of the distance with respect to the size of the first geom is not finite"),
    "value": (changed(point=lambda p: p / 0.0), "returns a point that is not finite"),
    "frame": (lambda a, b: (*(x[None] for x in spheres(a, b)[:2]), jnp.tile(spheres(a, b)[2], (1, 3, 1))), "returns a frame whose rows are not of length 1 and perpendicular"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_broken_pairs_are_named(what):
    function, sentence = BROKEN[what]
    with pytest.raises(AssertionError, match=f"(?=.*the contact pair sphere-sphere).*{re.escape(sentence)}"):
        check_contact_pair(ContactPair(("sphere", "sphere"), 1, function), num_states=8)


def test_bad_arguments_are_refused():
    pair = ContactPair(("sphere", "sphere"), 1, spheres)
    with pytest.raises(ValueError, match=r"^num_states is 0: use 1 or more$"):
        check_contact_pair(pair, num_states=0)
    with pytest.raises(ValueError, match=r"returned a distance of shape \(3,\): return shape \(1,\), or \(\)"):
        check_contact_pair(ContactPair(("sphere", "sphere"), 1, lambda a, b: (a.size, a.position, a.position)))


@pytest.mark.parametrize("kinds", [("plane", "cylinder"), ("capsule", "ellipsoid"), ("sphere", "box"), ("box", "box")])
def test_geoms_are_as_far_apart_as_asked(x64, kinds):
    """No point is nearer to both together than the gap between them."""

    @functools.partial(jax.jit, compiler_options=unoptimised())
    @jax.vmap
    def offsets(key, gap):
        state, at = touching(key, kinds, gap), jnp.linspace(0.0, 1.0, 9)[:, None]
        points = state.first.position + at * (state.second.position - state.first.position)
        first = jax.vmap(lambda p: distance_to(kinds[0], state.first, p))(points)
        second = jax.vmap(lambda p: distance_to(kinds[1], state.second, p))(points)
        return jnp.min(first + second), jnp.sum(state.normal**2)

    gaps = np.repeat([1e-3, 0.3], 20)
    least, square = offsets(jax.random.split(jax.random.key(2), 40), jnp.asarray(gaps))
    assert np.all(np.asarray(least) > 0.999 * gaps)
    np.testing.assert_allclose(square, 1.0, rtol=1e-12)


def test_stacked_geoms_touch(x64):
    for second in KINDS[1:]:
        state = stacked(("plane", second), (False, True), 0.002)
        point = state.second.position - jnp.array([0.0, 0.0, 1.0]) * (state.second.position[2] - 0.002)
        np.testing.assert_allclose(distance_to("plane", state.first, point), 0.002, atol=1e-12)
        np.testing.assert_allclose(distance_to(second, state.second, point), 0.0, atol=1e-9)


def doubled(first, second):
    """The same contact in two slots."""
    return tuple(jnp.stack([a, a]) for a in spheres(first, second))


def turned(first, second):
    """A second contact beside the first, with the opposite normal."""
    distance, point, normal = spheres(first, second)
    beside = point + 1e-4 * jnp.cross(normal, jnp.array([0.3, 0.5, 0.8]))
    return jnp.stack([distance, distance]), jnp.stack([point, beside]), jnp.stack([normal, -normal])


def aside(first, second):
    """A second contact away from both surfaces."""
    distance, point, normal = spheres(first, second)
    return jnp.stack([distance, 0.9 * distance]), jnp.stack([point, point + 10.0]), jnp.stack([normal, normal])


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (doubled, "returns the same contact in two slots"),
        (turned, "returns contacts of two geoms with opposite normals"),
        (aside, "from the surface of the sphere"),
    ],
)
def test_every_contact_is_checked(function, sentence):
    with pytest.raises(AssertionError, match=re.escape(sentence)):
        check_contact_pair(ContactPair(("sphere", "sphere"), 2, function), num_states=8)
