"""SoftJumper: the reference's numbers, muscles, the reward, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from soft_tasks import assert_reset_noise, difference_errors, make

from rewax.envs.tasks import soft_jumper
from rewax.status import Status

PAPER, SMALL = make("SoftJumper", "paper"), make("SoftJumper")


def test_paper_has_the_references_constants():
    scene, contact = PAPER.scene, PAPER.scene.contact
    assert (PAPER.num_substeps, PAPER.max_steps, PAPER.cloud.num_points) == (80, 300, 204)
    assert PAPER.control_dt == pytest.approx(1 / 60)
    assert (len(scene.tets), PAPER.action_spec.shape) == (444, (222,))
    found = [float(getattr(scene, name)) for name in ("mu", "lam", "damping")]
    np.testing.assert_allclose(found, [1000.0, 1000.0, 1.0])
    names = ("stiffness", "damping", "friction_damping", "friction", "radius")
    np.testing.assert_allclose([float(getattr(contact, n)) for n in names], [2e3, 0.1, 10.0, 0.7, 0.05], rtol=1e-6)
    np.testing.assert_allclose(float(scene.mass.sum()), 4.8975, rtol=1e-4)
    np.testing.assert_allclose(scene.gravity, [0.0, -9.81, 0.0], rtol=1e-6)
    np.testing.assert_allclose(PAPER.rest_positions[:, 1].min(), 0.007 + 0.2, atol=1e-3)
    assert {name: spec.shape for name, spec in PAPER.observation_spec.items()} == {
        "particle_q": (204, 3), "com_q": (3,), "com_qd": (3,), "actions": (222,),
    }  # fmt: skip


def test_reset_draws_the_references_noise():
    assert_reset_noise(PAPER)
    np.testing.assert_allclose(PAPER.noise.shift_lower, [-0.8, 0.0, -0.8])
    np.testing.assert_allclose(PAPER.noise.shift_upper, [0.8, 0.4, 0.8])
    assert float(PAPER.noise.stretch) == pytest.approx(0.1)


def test_each_action_drives_two_tets():
    action = jnp.linspace(-1.0, 1.0, 222)
    activation = np.asarray(PAPER.actuated(action).activation)
    np.testing.assert_allclose(activation, 0.3 * np.repeat(np.asarray(action), 2), rtol=1e-6)


def test_observations_are_a_tenth_of_positions_and_velocities():
    state = soft_tasks.run("SoftJumper", soft_tasks.start("SoftJumper"), 0.4, 2)[-1]
    x, v = np.asarray(state.physics.soft.x), np.asarray(state.physics.soft.v)
    np.testing.assert_allclose(state.obs["particle_q"], 0.1 * x, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(state.obs["com_q"], 0.1 * x.mean(0), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(state.obs["com_qd"], 0.1 * v.mean(0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(state.obs["actions"], 0.4, rtol=1e-6)


@pytest.mark.parametrize("env", [PAPER, SMALL])
def test_reward_is_the_formula(env):
    rng = np.random.default_rng(0)
    x = np.asarray(env.rest_positions) + rng.normal(size=env.rest_positions.shape)
    v, action = rng.normal(size=x.shape) + [2.0, 0.0, 0.0], rng.uniform(-1, 1, 222)
    state = soft_tasks.physics(env, x, v=v, action=jnp.asarray(action, jnp.float32))
    height = x[:, 1].mean() - np.asarray(env.rest_positions)[:, 1].mean()
    expected = v[:, 0].mean() + 3.0 * height - 0.001 * np.sum(action**2)
    np.testing.assert_allclose(env.reward(state)[0], expected, atol=2e-6)


def test_muscles_contract_the_body():
    """All of them at once: the body becomes smaller, and no tet turns inside out."""
    start = soft_tasks.start("SoftJumper")

    def volume(state):
        corners = np.asarray(state.physics.soft.x)[np.asarray(SMALL.scene.tets)]
        return np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6.0

    contracted, left = (soft_tasks.run("SoftJumper", start, a, 4)[-1] for a in (1.0, 0.0))
    assert volume(contracted) < 0.85 * volume(left)
    assert int(contracted.status) == Status.OK


def test_the_table_stands(x64):
    """Without activation it sags a little and comes to rest on its legs."""
    env = soft_jumper.small()
    state = env.reset(jax.random.key(1))
    state, heights = jax.jit(
        lambda s: jax.lax.scan(lambda s, _: ((n := env.step(s, jnp.zeros(222))), n.metrics["height"]), s, None, 90)
    )(state)
    assert np.ptp(np.asarray(heights)[-10:]) < 0.05
    assert float(state.physics.soft.x[:, 1].min()) > 0.02
    assert float(heights[-1]) > 0.75 * float(env.start_height)


def test_gradient_by_actions_is_that_of_differences(x64):
    """On the ground, its legs sliding."""
    env = soft_jumper.small()
    env = env.replace(rest_positions=env.rest_positions - jnp.array([0.0, 0.18, 0.0]), num_substeps=4)
    errors = difference_errors(env, num_steps=5, scale=0.9, h=1e-6)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-5
