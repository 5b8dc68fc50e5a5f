"""What one body and the nodes in touch with it give each other, against sums over the nodes written out."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material

from rewax.physics import mpm
from rewax.physics.contact import Collider, Overlap
from rewax.physics.contact.motion import Motion
from rewax.physics.coupling.nodes import NodeContact
from rewax.physics.mpm import Grid
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Sphere

ORIGIN = np.array([0.1, -0.2, 0.3])


def scene_of(friction, overlap=Overlap.SEQUENTIAL):
    ball = Collider(shape=Sphere(radius=jnp.asarray(0.5)), friction=jnp.asarray(friction), softness=jnp.asarray(50.0))
    return mpm.make_scene(
        grid=Grid(shape=(8, 8, 8), spacing=0.5), dt=1e-3, particle_volume=jnp.asarray(1e-3), overlap=overlap,
        material=flat_material(youngs_modulus=jnp.asarray(1e3), poissons_ratio=jnp.asarray(0.3), density=jnp.asarray(1e3)),
        colliders=(ball,),
    )  # fmt: skip


def nodes(n=40, seed=0):
    """Positions about the ball, masses, and velocities of which about half approach it."""
    rng = np.random.default_rng(seed)
    place = rng.normal(size=(3, n))
    place *= rng.uniform(0.3, 0.6, n) / np.linalg.norm(place, axis=0)
    return tuple(jnp.asarray(place)), jnp.asarray(rng.uniform(0.1, 1.0, n)), tuple(jnp.asarray(rng.normal(size=(3, n))))


class _Places(NamedTuple):
    """As much of ``ActiveNodes`` as contact needs."""

    position: tuple


def still():
    return Motion(jnp.zeros((3, 3)), jnp.zeros(3))


def contact_of(scene):
    """Nodes that meet the ball at rest, and their positions, masses and velocities."""
    position, mass, velocity = nodes()
    contact = NodeContact(scene, _Places(position), None, mass > 0, mass, velocity)
    return contact.meet(Pose(jnp.zeros((1, 3)), jnp.eye(3)[None]), [still()], None), position, mass, velocity


@pytest.mark.parametrize("friction", [0.0, 0.5, 100.0])
def test_bodies_get_what_nodes_lose(x64, friction):
    contact, position, mass, velocity = contact_of(scene_of(friction))
    after, (impulse, moment) = contact.exchange([None], jnp.asarray(ORIGIN)[None])
    lost = np.asarray(mass) * (np.stack(velocity) - np.stack(after.velocity))
    arm = np.stack(position) - np.asarray(ORIGIN)[:, None]
    np.testing.assert_allclose(impulse[0], lost.sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(moment[0], np.cross(arm.T, lost.T).sum(axis=0), rtol=1e-12)
    assert np.abs(lost).max() > 0.1


@pytest.mark.parametrize("friction", [0.0, 100.0])
def test_the_system_is_the_sum_over_approaching_nodes(x64, friction):
    """Without friction a node asks for its normal velocity alone, with a lot of it for all three."""
    contact, position, mass, velocity = contact_of(scene_of(friction))
    (found,), system = contact.touches, contact.system(0, ORIGIN)
    matrix, right = np.zeros((6, 6)), np.zeros(6)
    for k in range(len(mass)):
        x, v, n = (np.array([float(a[k]) for a in vector]) for vector in (position, velocity, found.normal))
        w = float(found.influence[k])
        if v @ n >= 0 or w <= 0.1:
            continue
        W = np.outer(n, n) if friction == 0.0 else np.eye(3)
        r = x - np.asarray(ORIGIN)
        J = np.concatenate([np.eye(3), -np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])], axis=1)
        matrix += float(mass[k]) * w * J.T @ W @ J
        right += float(mass[k]) * w * J.T @ W @ v
    whole = np.block([[np.asarray(system.a), np.asarray(system.b)], [np.asarray(system.b).T, np.asarray(system.c)]])
    np.testing.assert_allclose(whole, matrix, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(system.right, right, rtol=1e-10, atol=1e-12)


def test_another_body_adds_nothing(x64):
    system = contact_of(scene_of(0.5))[0].system(1, ORIGIN)
    assert not any(np.any(part) for part in system)


def test_bodies_that_move_otherwise_take_otherwise(x64):
    """With a motion of its own for the body, what it gets is what it would get had it moved so from the start."""
    contact, position, _, _ = contact_of(scene_of(0.5))
    turn = jnp.array([[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    motion, origins = Motion(turn, jnp.array([0.0, 0.0, 1.0])), jnp.asarray(ORIGIN)[None]
    meant = contact.meet(Pose(jnp.zeros((1, 3)), jnp.eye(3)[None]), [motion], None)
    np.testing.assert_allclose(meant.touches[0].velocity, [-2.0 * position[1], 2.0 * position[0], 0 * position[2] + 1])
    (found, given), (expected, wanted) = contact.exchange([motion], origins), meant.exchange([None], origins)
    np.testing.assert_allclose(found.velocity, expected.velocity, rtol=1e-12)
    np.testing.assert_allclose(given, wanted, rtol=1e-12)
    assert not np.allclose(given, contact.exchange([None], origins)[1], rtol=0.1)
