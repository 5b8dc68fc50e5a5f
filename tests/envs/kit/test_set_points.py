"""Joints follow set points as critically damped oscillators; actions move set points within limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax import struct
from rewax.envs.kit import PointCloud
from rewax.envs.kit.set_points import Following, Steered
from rewax.physics import thin

MESH = thin.rope(np.linspace([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], 3))


@struct.dataclass
class Held(Steered):
    """A rope's end in a hand that moves along x and y."""

    def pins(self, physics, joint_q):
        return jnp.concatenate([joint_q, jnp.zeros_like(joint_q[:, :1])], axis=1)[:, None]

    def reward(self, physics):
        return physics.joint_q[0], {}


def held(kind=Held, **changes):
    rope = thin.Rope(stretch=5.0, bending=1e-5, density=0.1, damping=1e-3)
    return kind(
        scene=thin.make_scene(mesh=MESH, dt=1e-3, rope=rope, held=[0], drag=1.0),
        rest_positions=MESH.vertices,
        joint_start=changes.pop("joint_start", (0.0, 0.0)),
        joint_lower=(-0.1, -0.1),
        joint_upper=(0.1, 0.03),
        joint_step=(0.02, 0.02),
        rate=12.0,
        cloud=PointCloud(num_points=3),
        num_substeps=20,
        max_steps=200,
        **changes,
    )


def test_set_points_move_within_limits_and_the_hand_follows_without_jumps():
    env = held()
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    speeds, places = [np.zeros(2)], [np.zeros(2)]
    assert not np.any(env.ahead(state.physics))
    for k in range(40):
        state = step(state, jnp.array([1.0, 1.0]) if k < 3 else jnp.zeros(2))
        if k == 0:
            np.testing.assert_allclose(env.ahead(state.physics) + state.physics.joint_q, [0.02, 0.02], atol=1e-6)
        speeds.append(np.asarray(state.physics.joint_qd))
        places.append(np.asarray(state.physics.joint_q))
    np.testing.assert_allclose(state.physics.task, [0.06, 0.03], atol=1e-6)
    np.testing.assert_allclose(state.physics.joint_q, [0.06, 0.03], atol=1e-4)
    np.testing.assert_allclose(np.asarray(state.physics.soft.x)[0, :2], state.physics.joint_q, atol=1e-6)
    jump = 0.02 * 12.0**2 * env.control_dt  # the largest acceleration is rate^2 times the step of a set point
    assert np.abs(np.diff(speeds, axis=0)).max() < 3.0 * jump
    between = 0.5 * (np.array(speeds[1:]) + speeds[:-1]) * env.control_dt
    np.testing.assert_allclose(np.diff(places, axis=0), between, atol=2e-4)


def test_the_oscillator_is_the_exact_solution(x64):
    env = held()
    q, v, p = jnp.array([0.01, -0.02]), jnp.array([0.3, -0.1]), np.array([0.05, 0.01])
    physics = jax.jit(env.reset)(jax.random.key(0)).physics.replace(joint_q=q, joint_qd=v, task=jnp.asarray(p))
    after, _ = jax.jit(env.advance)(physics, jnp.zeros(2))
    x, w = np.array([q, v]), 12.0
    for _ in range(20_000):  # x'' = -2 w x' - w^2 (x - p), in small steps
        middle = x + 0.5e-6 * np.array([x[1], -2 * w * x[1] - w * w * (x[0] - p)])
        x = x + 1e-6 * np.array([middle[1], -2 * w * middle[1] - w * w * (middle[0] - p)])
    np.testing.assert_allclose(after.joint_q, x[0], rtol=1e-7)
    np.testing.assert_allclose(after.joint_qd, x[1], rtol=1e-7)


def test_a_task_without_set_points_is_named():
    with pytest.raises(NotImplementedError, match=r"has no set_point\(physics, action\): define it"):
        held(Following).set_point(None, jnp.zeros(2))


def test_set_points_begin_within_their_limits():
    env = held().replace(joint_lower=jnp.array([-0.1, 0.02]))
    assert np.allclose(env.ahead(env.reset(jax.random.key(0)).physics), [0.0, 0.02])


def test_a_set_point_that_stands_at_its_limit_can_leave_it():
    env = held()
    physics = env.reset(jax.random.key(0)).physics

    def last(actions):
        task = env.joint_upper
        for action in actions:
            task = env.set_point(physics.replace(task=task), action)
        return task.sum()

    by_action = jax.grad(last)(jnp.zeros((4, 2)))
    np.testing.assert_allclose(by_action, np.broadcast_to(env.joint_step, (4, 2)), rtol=1e-6)


def test_frozen_limits_are_refused():
    with pytest.raises(ValueError, match="exact_limits is False, but joints that follow set points have no limits"):
        held().replace(exact_limits=False)


def test_joints_may_start_anywhere_because_their_limits_are_those_of_set_points():
    env = held(joint_start=(0.0, -0.5))
    np.testing.assert_allclose(env.reset(jax.random.key(0)).physics.task, [0.0, -0.1])
