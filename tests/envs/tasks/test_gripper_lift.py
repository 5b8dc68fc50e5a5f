"""GripperLift: what the gripper feels, the reward, gradients through both ways of the coupling."""

import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from soft_tasks import difference_errors, make

import rewax
from rewax.envs.kit.coupled_task import CoupledPhysics
from rewax.physics import mpm
from rewax.status import Status

ENV = make("GripperLift")


def run(actions):
    """States after each of several actions and their numbers of steps."""
    state, states = soft_tasks.start("GripperLift"), []
    for action, num in actions:
        found = soft_tasks.run("GripperLift", state, action, num)
        state, states = found[-1], [*states, *found]
    return states


def weight(env=ENV):
    mass = mpm.particle_mass(env.scene, env.rest_positions).sum()
    return 9.81 * float(mass)


def test_the_block_weighs_half_a_kilogram():
    assert weight() / 9.81 == pytest.approx(0.512, rel=1e-3)
    assert weight(make("GripperLift", "paper")) == pytest.approx(weight(), rel=1e-3)


def test_a_gripper_that_holds_the_block_feels_its_weight():
    """Squeezed, lifted slowly, then held: the fingers carry the block, and the motors with it."""
    states = run([([0.0, 0.8, 0.8], 20), ([0.45, 0.8, 0.8], 25), ([0.416, 0.8, 0.8], 15)])
    end = states[-1]
    assert float(end.metrics["height"]) > float(ENV.start_height) + 0.02
    down = np.mean([-np.asarray(s.physics.touch.force)[2:, 1].sum() for s in states[-10:]])
    accelerated = float(end.physics.soft.v[:, 1].mean() - states[-11].physics.soft.v[:, 1].mean()) / (
        10 * ENV.control_dt
    )
    assert down == pytest.approx(weight() * (1.0 + accelerated / 9.81), rel=0.05)
    squeeze = np.asarray(end.physics.touch.force)[2:, 0]
    assert squeeze[0] < -10.0 and squeeze[1] > 10.0  # the block pushes the fingers apart
    assert all(int(s.status) == Status.OK for s in states)


def test_a_gripper_that_holds_nothing_stays_where_it_is():
    """The middle of the lift's range carries the gripper alone, but for some tenths of a newton."""
    start, end = soft_tasks.start("GripperLift"), run([([0.0, -1.0, -1.0], 20)])[-1]
    assert abs(float(end.physics.rigid.qpos[0] - start.physics.rigid.qpos[0])) < 0.02
    assert np.abs(np.asarray(end.physics.touch.force)).max() == 0.0


@pytest.mark.parametrize(("height", "shift"), [(0.11, 0.0), (0.23, 0.05), (0.3, -0.02)])
def test_reward_is_the_formula(height, shift):
    state = soft_tasks.start("GripperLift")
    x = np.asarray(ENV.rest_positions) + [shift, height - np.asarray(ENV.rest_positions)[:, 1].mean(), 0.0]
    soft, action = state.physics.soft.replace(x=jnp.asarray(x)), jnp.array([0.5, -0.2, 1.0])
    physics: CoupledPhysics = state.physics.replace(soft=soft, action=action)
    reward, metrics = ENV.reward(physics)
    gap = np.mean([max(abs(finger - x[:, 0].mean()) - 0.02 - 0.04, 0.0) for finger in (0.12, 0.28)])
    lifted = 1.0 - ((ENV.target - height) / (ENV.target - ENV.start_height)) ** 2
    np.testing.assert_allclose(reward, lifted - 10.0 * gap - 0.01 * (0.25 + 0.04 + 1.0), atol=2e-6)
    assert float(metrics["success"]) == float(abs(height - float(ENV.target)) < 0.02)


def test_observations_hold_points_joints_and_touch():
    state = run([([0.0, 1.0, 1.0], 8)])[-1]
    np.testing.assert_array_equal(state.obs["particle_q"], state.physics.soft.x[::8][:64])
    np.testing.assert_array_equal(state.obs["joints"][:3], state.physics.rigid.qpos)
    np.testing.assert_allclose(
        state.obs["joints"][6:].reshape(2, 2), 0.1 * state.physics.touch.force[2:, :2], rtol=1e-6
    )


def test_a_model_whose_substep_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"^the scene's dt 0\.0015 s does not divide the model's 0\.002 s"):
        ENV.replace(scene=ENV.scene.replace(dt=1.5e-3))


@pytest.mark.slow
def test_gradient_by_actions_is_that_of_differences(x64):
    """Fingers that close on the block, and lift."""
    env = rewax.make("GripperLift", scale="small").replace(num_substeps=3, list_every=None)
    joints = jnp.array([0.0, 0.022, 0.022])

    class Held:
        action_spec = env.action_spec
        step = staticmethod(env.step)

        @staticmethod
        def reset(key):
            state = env.reset(key)
            soft = state.physics.soft.replace(x=env.rest_positions)
            return state.replace(
                physics=state.physics.replace(soft=soft, rigid=state.physics.rigid.replace(qpos=joints))
            )

    errors = difference_errors(Held, num_steps=4, scale=0.9, h=1e-6)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-5
