"""Impulses at points, shared over patches of bodies: against sums written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.contact import WALLS, Patches
from rewax.physics.contact.patches import accumulated, check_patches, feels_walls, felt, no_touch
from rewax.physics.numerics import Pose

NUM = 50


def points(rotations):
    rng = np.random.default_rng(0)
    position, first, second, walls = rng.normal(size=(4, 3, NUM))
    bodies = Pose(jnp.asarray(rng.normal(size=(3, 3))), jnp.asarray(rotations(0, 3)))
    return position, [(2, first), (0, second), (2, walls), (WALLS, walls)], bodies


def parts(array):
    return tuple(jnp.asarray(array))


def by_hand(received, position, origin, body, mask):
    total = sum(np.asarray(v) for owner, v in received if owner == body) * mask
    return total.sum(1), np.cross((position - origin[:, None]).T, total.T).sum(0)


def test_a_patch_feels_the_points_nearest_to_it(x64, rotations):
    position, received, bodies = points(rotations)
    center = np.random.default_rng(1).normal(size=(5, 3))
    patches = Patches(body=(2, 2, 0, 2, WALLS), center=center)
    found = felt(patches, parts(position), [(b, parts(v)) for b, v in received], bodies)
    origins = np.concatenate([bodies.position, np.zeros((1, 3))])
    turns = np.concatenate([bodies.rotation, np.eye(3)[None]])
    for patch, body in enumerate(patches.body):
        own = [k for k in range(5) if patches.body[k] == body]
        at = np.stack([origins[body] + turns[body] @ center[k] for k in own])
        nearest = np.linalg.norm(position[None] - at[:, :, None], axis=1).argmin(0)
        force, torque = by_hand(received, position, origins[body], body, nearest == own.index(patch))
        np.testing.assert_allclose(found.force[patch], force, atol=1e-12)
        np.testing.assert_allclose(found.torque[patch], torque, atol=1e-12)


def test_patches_of_a_body_sum_to_the_whole_and_traced_owners_are_the_same(x64, rotations):
    position, received, bodies = points(rotations)
    given = [(jnp.full(NUM, body), parts(v)) for body, v in received]
    both = {"whole": Patches(body=(0, 2)), "split": Patches(body=(2,) * 4, center=np.eye(4, 3))}
    found = jax.jit(lambda bodies: felt(both, parts(position), given, bodies))(bodies)
    for whole, split in zip(found["whole"], found["split"], strict=True):
        np.testing.assert_allclose(split.sum(0), whole[1], atol=1e-12)
    static = felt(both["whole"], parts(position), [(b, parts(v)) for b, v in received], bodies)
    np.testing.assert_allclose(found["whole"].torque, static.torque, atol=1e-12)


def test_angular_impulses_add_to_the_torque(x64, rotations):
    position, received, bodies = points(rotations)
    given = [(b, parts(v)) for b, v in received]
    without = felt(Patches(body=(0, 2)), parts(position), given, bodies)
    spun = felt(Patches(body=(0, 2)), parts(position), given, bodies, turned_by=[(2, parts(received[0][1]))])
    np.testing.assert_array_equal(spun.force, without.force)
    np.testing.assert_allclose(spun.torque - without.torque, [np.zeros(3), received[0][1].sum(1)], atol=1e-12)


def test_trees_of_patches_start_at_zero_and_accumulate():
    tree = {"a": Patches(body=(0, WALLS)), "b": Patches(body=(1,))}
    start = no_touch(tree, jnp.ones(3))
    total = accumulated(start, jax.tree.map(jnp.ones_like, start), 0.5)
    assert total["a"].force.shape == (2, 3) and np.all(total["b"].torque == 0.5)
    assert feels_walls(tree) and not feels_walls(tree["b"])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Patches(body=(0, 0)), r"body is \(0, 0\), with several patches of one body"),
        (lambda: Patches(body=(0, 0), center=np.zeros((1, 3))), r"center has shape \(1, 3\)"),
        (lambda: Patches(body=(0.5,)), r"body is \(0.5,\): give at least one index of a body, an integer, or WALLS"),
        (lambda: Patches(body=()), r"body is \(\): give at least one index"),
        (lambda: check_patches(Patches(body=(3,)), 3), "a patch belongs to body 3, but there are 3 bodies"),
        (lambda: check_patches({"a": 1.0}, 3), r"patches holds 1.0: give Patches"),
    ],
)
def test_bad_patches_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
