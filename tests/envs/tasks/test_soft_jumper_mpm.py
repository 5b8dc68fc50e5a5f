"""SoftJumperMPM: SoftJumper's body, actions, reward and noise on particles; gradients; a box that goes with the body."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from soft_tasks import assert_reset_noise, difference_errors, make

from rewax.envs.tasks import soft_jumper_mpm
from rewax.physics import mpm
from rewax.status import Status

PAPER, SMALL = make("SoftJumperMPM", "paper"), make("SoftJumperMPM")
TETS = make("SoftJumper", "paper")


@pytest.mark.parametrize(("env", "num", "substeps", "steps"), [(PAPER, 2970, 16, 300), (SMALL, 880, 8, 90)])
def test_body_and_material_are_those_of_soft_jumper(env, num, substeps, steps):
    assert (len(env.rest_positions), env.num_substeps, env.max_steps) == (num, substeps, steps)
    assert env.control_dt == pytest.approx(1 / 60) and env.action_spec.shape == TETS.action_spec.shape == (222,)
    assert {n: s.shape for n, s in env.observation_spec.items()} == {
        n: s.shape for n, s in TETS.observation_spec.items()
    }
    mass = mpm.particle_mass(env.scene, env.rest_positions)
    np.testing.assert_allclose(mass.sum(), TETS.scene.mass.sum(), rtol=1e-5)
    for x, m in ((env.rest_positions, mass), (TETS.rest_positions, TETS.scene.mass)):
        center = np.average(np.asarray(x), axis=0, weights=np.asarray(m))
        np.testing.assert_allclose(center, [0.0805, 1.528, 0.0195], atol=0.01)
    # Small strains: the stable neo-Hookean law with mu = lam = 1000 Pa.
    elasticity = env.scene.material.elasticity
    assert (float(elasticity.youngs_modulus), float(elasticity.poissons_ratio)) == pytest.approx((1750, 1 / 6))
    assert float(env.strength) == pytest.approx(300.0)
    np.testing.assert_allclose(env.scene.gravity, [0.0, -9.81, 0.0], rtol=1e-6)


@pytest.mark.parametrize("env", [PAPER, SMALL])
def test_muscles_are_those_of_the_tets(env):
    """Every action has particles; each lies within the tets of its action, and pulls upright in legs, along x above."""
    table = soft_jumper_mpm.table(env.per_cell)
    assert np.bincount(table.muscle, minlength=222).min() > 0
    corners = np.asarray(TETS.rest_positions)[np.asarray(TETS.scene.tets)].reshape(222, 8, 3)
    x = np.asarray(env.rest_positions)
    assert np.all(x >= corners.min(axis=1)[table.muscle] - 1e-3) and np.all(
        x <= corners.max(axis=1)[table.muscle] + 1e-3
    )
    in_legs = x[:, 1] < 0.207 + 3 * 0.3544
    np.testing.assert_array_equal(table.fibre, np.where(in_legs[:, None], [0, 1, 0], [1, 0, 0]))
    action = np.linspace(-1, 1, 222)
    found = env.actuated(jnp.asarray(action)).material.muscle.activation
    np.testing.assert_allclose(found, 300.0 * action[table.muscle], rtol=1e-5)


@pytest.mark.parametrize("env", [PAPER, SMALL])
def test_observed_particles_are_those_nearest_to_the_vertices(env):
    seen = np.asarray(env.cloud.pick(env.rest_positions))
    away = np.linalg.norm(seen - np.asarray(TETS.rest_positions), axis=1)
    np.testing.assert_allclose(away, 0.5 * np.sqrt(3) * 0.354428 / env.per_cell, rtol=1e-3)


def test_reset_draws_soft_jumpers_noise_and_strains_the_body():
    assert_reset_noise(PAPER)
    for env in (PAPER, SMALL):
        tets = make("SoftJumper", "paper" if env is PAPER else "small")
        for name in ("shift_lower", "shift_upper", "stretch"):
            np.testing.assert_array_equal(getattr(env.noise, name), getattr(tets.noise, name))
    states = jax.jit(jax.vmap(PAPER.begin))(jax.random.split(jax.random.key(0), 16))[0].soft
    stretch = np.ptp(np.asarray(states.x), axis=1) / np.ptp(np.asarray(PAPER.rest_positions), axis=0)
    expected = stretch[:, 0, None, None, None] * np.broadcast_to(np.eye(3), (1, 2970, 3, 3))
    np.testing.assert_allclose(states.F, np.broadcast_to(expected, states.F.shape), atol=1e-5)
    assert np.ptp(stretch) > 0.1


@pytest.mark.parametrize("env", [PAPER, SMALL])
def test_reward_is_the_formula(env):
    rng = np.random.default_rng(0)
    x = np.asarray(env.rest_positions) + rng.normal(size=env.rest_positions.shape)
    v, action = rng.normal(size=x.shape) + [2.0, 0.0, 0.0], rng.uniform(-1, 1, 222)
    state = soft_tasks.physics(env, x, v=v, action=jnp.asarray(action, jnp.float32))
    height = x[:, 1].mean() - np.asarray(env.rest_positions)[:, 1].mean()
    expected = v[:, 0].mean() + 3.0 * height - 0.001 * np.sum(action**2)
    np.testing.assert_allclose(env.reward(state)[0], expected, atol=2e-6)


def test_muscles_lift_and_shorten_the_body():
    """Legs that push make it higher, slabs that pull make it shorter."""
    start, leg = soft_tasks.start("SoftJumperMPM"), soft_jumper_mpm.table(2).fibre[:, 1] > 0
    in_legs = np.zeros(222)
    in_legs[np.unique(soft_jumper_mpm.table(2).muscle[leg])] = 1.0
    ends = [soft_tasks.run("SoftJumperMPM", start, a, 4)[-1] for a in (-in_legs, 0 * in_legs, 1.0 - in_legs)]
    x = [np.asarray(s.physics.soft.x) for s in ends]
    assert x[0][:, 1].mean() > x[1][:, 1].mean() + 0.02
    assert np.ptp(x[2][~leg, 0]) < 0.95 * np.ptp(x[1][~leg, 0])
    assert all(int(s.status) == Status.OK for s in ends)


def test_the_box_goes_with_the_body():
    """A hundred cells further on, the same happens."""
    start, h = soft_tasks.start("SoftJumperMPM"), SMALL.scene.grid.spacing
    away = jnp.array([100.0 * h, 0.0, -37.0 * h])
    soft = start.physics.soft
    far = start.replace(physics=start.physics.replace(soft=soft.replace(x=soft.x + away)))
    action = np.random.default_rng(0).uniform(-1, 1, 222)
    near, far = (soft_tasks.run("SoftJumperMPM", s, action, 3)[-1] for s in (start, far))
    np.testing.assert_allclose(far.physics.soft.x - away, near.physics.soft.x, atol=1e-4)
    np.testing.assert_allclose(far.physics.soft.F, near.physics.soft.F, atol=1e-3)
    assert int(far.status) == int(near.status) == Status.OK


@pytest.mark.slow
def test_gradient_by_actions_is_that_of_differences(x64):
    """One control step on the ground."""
    env = soft_jumper_mpm.small()
    env = env.replace(rest_positions=env.rest_positions - jnp.array([0.0, 0.1, 0.0]))
    errors = difference_errors(env, num_steps=1, scale=0.9, h=1e-6)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-5
