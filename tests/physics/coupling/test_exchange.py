"""Sums over the contact points of a body, against the same written out."""

import jax.numpy as jnp
import numpy as np

from rewax.physics.coupling.exchange import Received, add_contact, no_system, no_wrench


def drawn(n=20, seed=0):
    """Arms, unit normals, what bodies are asked for along them and whole, momenta lost."""
    rng = np.random.default_rng(seed)
    arm, normal, lost = rng.normal(size=(3, 3, n))
    return arm, normal / np.linalg.norm(normal, axis=0), rng.uniform(size=n), rng.uniform(size=n), lost


def test_a_system_is_the_sum_over_the_places(x64):
    arm, normal, along, whole, lost = drawn()
    half = (
        [a[..., :7] for a in (arm, normal, along, whole, lost)],
        [a[..., 7:] for a in (arm, normal, along, whole, lost)],
    )
    system = no_system(jnp.float64)
    for r, n, a, w, p in half:
        system = add_contact(system, tuple(jnp.asarray(r)), tuple(jnp.asarray(n)), jnp.asarray(a), jnp.asarray(w), tuple(jnp.asarray(p)))  # fmt: skip
    matrix, right = np.zeros((6, 6)), np.zeros(6)
    for k in range(len(along)):
        x, y, z = arm[:, k]
        J = np.concatenate([np.eye(3), -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])], axis=1)
        W = along[k] * np.outer(normal[:, k], normal[:, k]) + whole[k] * np.eye(3)
        matrix, right = matrix + J.T @ W @ J, right + J.T @ lost[:, k]
    found = np.block([[np.asarray(system.a), np.asarray(system.b)], [np.asarray(system.b).T, np.asarray(system.c)]])
    np.testing.assert_allclose(found, matrix, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(system.right, right, rtol=1e-12)


def test_bodies_receive_about_their_own_origins(x64):
    arm, _, _, _, lost = drawn()
    position, origins = tuple(jnp.asarray(arm)), jnp.asarray([[0.0, 0.0, 0.0], [1.0, -2.0, 0.5]])
    none = Received(jnp.zeros((2, 3)), jnp.zeros((2, 3)))
    first = none.and_from(position, tuple(jnp.asarray(lost)), 1, origins)
    np.testing.assert_allclose(first.impulse, [[0, 0, 0], lost.sum(1)], rtol=1e-12)
    moment = np.cross((arm - np.asarray(origins[1])[:, None]).T, lost.T).sum(0)
    np.testing.assert_allclose(first.moment, [[0, 0, 0], moment], rtol=1e-12)
    twice = first.and_from(position, tuple(jnp.asarray(lost)), 1, origins)
    np.testing.assert_allclose(twice.moment, 2 * first.moment, rtol=1e-12)


def test_no_wrench_is_zero():
    wrench = no_wrench(3)
    assert wrench.force.shape == wrench.torque.shape == (3, 3)
    assert not np.any(wrench.force) and not np.any(wrench.torque)
    assert no_wrench(2, np.ones(1, np.float16)).torque.dtype == np.float16
