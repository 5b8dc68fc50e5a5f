"""Velocity lost to each collider: the sum of losses is what ``apply_colliders`` takes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.contact import Collider, Overlap, apply_colliders, place
from rewax.physics.contact.losses import velocity_losses
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box, Sphere


def moving(num):
    """Overlapping balls and a box that move towards the nodes."""
    balls = [Collider(shape=Sphere(radius=0.2 + 0.01 * k), friction=0.3, softness=20.0, body=k) for k in range(num)]
    colliders = (*balls, Collider(shape=Box(half_size=(0.1, 0.2, 0.1)), friction=0.3, softness=20.0, body=num))
    at = jnp.linspace(-0.3, 0.3, num + 1)[:, None] * jnp.array([1.0, 0.2, 0.0])
    turn = jnp.broadcast_to(jnp.eye(3), (num + 1, 3, 3))
    placed = place(colliders, Pose(at, turn), Pose(at + 0.01, turn), 0.01)
    return [(c, jax.tree.map(lambda a, k=k: a[k], placed)) for k, c in enumerate(colliders)]


@pytest.mark.parametrize("overlap", Overlap)
@pytest.mark.parametrize("num", [0, 1, 5])
def test_losses_are_what_the_colliders_take_in_turn(x64, num, overlap):
    rng = np.random.default_rng(num)
    position, velocity = (tuple(jnp.asarray(a)) for a in 0.3 * rng.normal(size=(2, 3, 60)))
    colliders = moving(num)
    after, lost = jax.jit(lambda v: velocity_losses(colliders, position, v, overlap=overlap))(velocity)
    expected = jax.jit(lambda v: apply_colliders(colliders, position, v, overlap=overlap))(velocity)
    np.testing.assert_allclose(np.stack(after), np.stack(expected), atol=1e-14)
    taking = sum(np.abs(np.stack(one)).max() > 1e-3 for one in lost)
    assert len(lost) == num + 1 and taking >= (num + 1 if overlap is Overlap.SEQUENTIAL else (num + 1) // 2)
    np.testing.assert_allclose(np.stack(velocity) - np.sum([np.stack(one) for one in lost], axis=0), np.stack(after), atol=1e-12)  # fmt: skip
    if overlap is Overlap.SEQUENTIAL:
        first = apply_colliders(colliders[:1], position, velocity)
        np.testing.assert_allclose(np.stack(velocity) - np.stack(lost[0]), np.stack(first), atol=1e-14)


def test_no_colliders_take_nothing():
    velocity = tuple(jnp.ones((3, 4)))
    assert velocity_losses([], velocity, velocity) == (velocity, [])
