"""What one body and the nodes in touch with it give each other, against sums over the nodes written out."""

from typing import NamedTuple

import jax
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
from rewax.physics.numerics.rotations import skew
from rewax.physics.shapes import Sphere

ORIGIN = np.array([0.1, -0.2, 0.3])


def scene_of(friction, overlap=Overlap.SEQUENTIAL, offsets=((0.0, 0.0, 0.0),)):
    ball = Collider(shape=Sphere(radius=jnp.asarray(0.5)), friction=jnp.asarray(friction), softness=jnp.asarray(50.0))
    return mpm.make_scene(
        grid=Grid(shape=(8, 8, 8), spacing=0.5), dt=1e-3, particle_volume=jnp.asarray(1e-3), overlap=overlap,
        material=flat_material(youngs_modulus=jnp.asarray(1e3), poissons_ratio=jnp.asarray(0.3), density=jnp.asarray(1e3)),
        colliders=tuple(ball.replace(offset=jnp.asarray(offset)) for offset in offsets),
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


def motion_of(twist):
    """The motion of a body with a velocity at the origin of moments and an angular velocity."""
    turn = skew(twist[3:])
    return Motion(turn, twist[:3] - turn @ ORIGIN)


def contact_of(scene, scale=1.0):
    """Nodes that meet the ball at rest, and their positions, masses and velocities."""
    position, mass, velocity = nodes()
    position = tuple(scale * a for a in position)
    contact = NodeContact(scene, _Places(position), None, mass > 0, mass, velocity)
    return contact.meet(Pose(jnp.zeros((1, 3)), jnp.eye(3)[None]), [still()], None), position, mass, velocity


def matrix_of(system):
    return np.block([[system.a, system.b], [system.b.T, system.c]])


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
    np.testing.assert_allclose(matrix_of(system), matrix, rtol=1e-10, atol=1e-12)
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


@pytest.mark.parametrize("friction", [0.0, 0.5, 100.0])
@pytest.mark.parametrize("overlap", Overlap)
def test_a_node_counts_once_in_several_equal_colliders_of_a_body(x64, friction, overlap):
    """All nodes are inside, where the first collider does everything."""
    one, three = (
        contact_of(scene_of(friction, overlap, offsets=[(0.0, 0.0, 0.0)] * n), scale=0.8)[0].system(0, ORIGIN)
        for n in (1, 3)
    )
    for found, expected in zip(three, one, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


TWO = ((0.0, 0.0, 0.0), (0.1, 0.05, -0.1))
"""Offsets of two balls that overlap, so that their normals differ and nodes feel one or both."""


@pytest.mark.parametrize("friction", [0.0, 100.0])
def test_the_system_of_several_colliders_is_the_symmetric_part_of_the_derivative(x64, friction):
    """Of the impulse on the body by its own velocity. Nodes slide freely or stick: friction's share is constant."""
    contact = contact_of(scene_of(friction, offsets=TWO))[0]

    def received(twist):
        return jnp.concatenate(contact.exchange([motion_of(twist)], jnp.asarray(ORIGIN)[None])[1], axis=1)[0]

    slope = -jax.jacfwd(received)(jnp.zeros(6))
    found = matrix_of(contact.system(0, ORIGIN))
    np.testing.assert_allclose(found, 0.5 * (slope + slope.T), rtol=1e-9, atol=1e-9 * np.abs(found).max())
    assert not np.allclose(found, matrix_of(contact_of(scene_of(friction))[0].system(0, ORIGIN)), rtol=0.1)


def test_a_body_without_mass_goes_with_nodes_that_move_as_one(x64):
    contact, position, _, _ = contact_of(scene_of(0.5, offsets=TWO))
    velocity, spin = np.array([0.3, -1.0, 0.2]), np.array([0.5, 0.1, -0.4])
    field = velocity[:, None] + np.cross(spin, (np.stack(position) - ORIGIN[:, None]).T).T
    system = contact._replace(velocity=tuple(jnp.asarray(field))).system(0, ORIGIN)
    np.testing.assert_allclose(np.linalg.solve(matrix_of(system), system.right), [*velocity, *spin], rtol=1e-9)


def test_derivatives_through_contact_with_two_colliders_of_a_body(x64, random_like, derivatives_agree):
    """Of the velocities after contact with a free ball of 2 kg, by nodes, motion, friction and sizes."""
    scene, (position, mass, velocity) = scene_of(0.4, offsets=TWO), nodes()

    def after(arguments):
        colliders, mass, velocity, twist = arguments
        contact = NodeContact(scene.replace(colliders=colliders), _Places(position), None, mass > 0, mass, velocity)
        contact = contact.meet(Pose(jnp.zeros((1, 3)), jnp.eye(3)[None]), [motion_of(twist)], None)
        system = contact.system(0, ORIGIN)
        a, b, c = system.a + 2.0 * jnp.eye(3), system.b, system.c + 0.3 * jnp.eye(3)
        changed = twist + jnp.linalg.solve(jnp.block([[a, b], [b.T, c]]), system.right)
        contact, received = contact.exchange([motion_of(changed)], jnp.asarray(ORIGIN)[None])
        return changed, contact.velocity, received

    arguments = (scene.sized_colliders, mass, velocity, jnp.array([0.1, -0.2, 0.1, 0.3, 0.2, -0.1]))
    derivatives_agree(after, arguments, random_like(1, arguments), step=1e-7, bar=1e-6, exact=1e-10)
