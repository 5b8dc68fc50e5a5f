"""Where bodies are and how they move: rates, work, turns by any angle."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from trees import compiled, draw, parameters_of

from rewax.physics.rigid.kinematic_tree import JointType, tree_topology
from rewax.physics.rigid.kinematics import (
    body_velocities,
    generalized_forces,
    integrate,
    kinematics,
    moving_points,
)
from rewax.physics.rigid.small_products import rotate


def test_velocities_are_rates_of_positions_and_forces_their_dual(x64):
    """d/dt of a point of a body; work of a force at that point = work of its generalized force."""
    mj, topology, _ = compiled("odd")
    q, v, _ = (jnp.asarray(x) for x in draw(mj, 5))
    parameters, rng = parameters_of(mj), np.random.default_rng(1)
    body, local, force = jnp.arange(mj.nbody), rng.standard_normal((mj.nbody, 3)), rng.standard_normal((mj.nbody, 3))

    @jax.jit
    def measure(q, v):
        def place(t):
            kin = kinematics(topology, parameters, integrate(topology, q, v, t))
            return kin.position + rotate(kin.rotation, jnp.asarray(local))

        point, rate = jax.jvp(place, (0.0,), (1.0,))
        kin = kinematics(topology, parameters, q)
        twist = body_velocities(topology, kin, v)
        velocity, wrenches = moving_points(kin, twist, body, point)
        return rate, velocity, generalized_forces(topology, kin, wrenches(jnp.asarray(force)))

    rate, velocity, generalized = measure(q, v)
    np.testing.assert_allclose(velocity, rate, atol=1e-12)
    assert np.sum(force * velocity) == pytest.approx(float(generalized @ v), rel=1e-12)
    assert np.abs(velocity[1:]).min(axis=1).max() > 0.1


AXES = [np.array([0.6, -0.48, 0.64]), np.array([0.0, 0.0, 1.0])]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.9e-3, 2.1e-3, 0.3, 3.0, 9.0])
def test_turning_is_exact_at_every_angle_and_so_is_its_derivative(x64, angle):
    """Near 2e-3 a series begins to replace sine and cosine; at zero a naive derivative is 0 or NaN."""
    topology = tree_topology(np.array([0, 0]), np.array([1]), np.array([JointType.BALL]))
    start, dt = np.array([0.5, 0.5, -0.1, 0.7]), 0.02
    start /= np.linalg.norm(start)
    turn = jax.jit(lambda q, w: integrate(topology, q, w, dt))
    derivative = jax.jit(jax.jacfwd(lambda w: integrate(topology, jnp.asarray(start), w, dt)))
    for axis in AXES:
        rate = axis * angle / dt
        expected = np.zeros(4)
        mujoco.mju_mulQuat(expected, start, np.append(np.cos(angle / 2), np.sin(angle / 2) * axis))
        np.testing.assert_allclose(turn(start, rate), expected, atol=1e-15)
        assert np.linalg.norm(turn(3.0 * start, rate)) == pytest.approx(1.0, abs=1e-15)
        step = 1e-5
        moves = [(turn(start, rate + step * e) - turn(start, rate - step * e)) / (2 * step) for e in np.eye(3)]
        np.testing.assert_allclose(derivative(rate), np.stack(moves, axis=1), atol=1e-11)
        reverse = jax.jit(jax.jacrev(lambda w: integrate(topology, jnp.asarray(start), w, dt)))(rate)
        np.testing.assert_allclose(reverse, derivative(rate), atol=1e-15)
    if angle == 0.0:
        half = 0.5 * dt * np.stack([mul(start, np.append(0.0, e)) for e in np.eye(3)], axis=1)
        np.testing.assert_allclose(derivative(rate), half, atol=1e-15)


def mul(a, b):
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, a, b)
    return out
