"""HandLift: the reference's numbers, the reward, what closing the hand does, gradients."""

import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from flat_materials import flat_numbers
from soft_tasks import difference_errors, make

from rewax.envs.kit.soft_parts import lattice_box
from rewax.envs.tasks import hand_lift
from rewax.physics.mpm import Hencky, VonMises
from rewax.physics.mpm.walls import WallKind
from rewax.status import Status

PAPER, SMALL = make("HandLift", "paper"), make("HandLift")


def test_paper_has_the_references_constants():
    scene, material = PAPER.scene, PAPER.scene.material
    assert (PAPER.num_substeps, PAPER.max_steps, PAPER.cloud.num_points, PAPER.cloud.stride) == (40, 100, 250, 32)
    assert scene.dt == 5e-5 and scene.grid.spacing == 1 / 64 and PAPER.action_spec.shape == (24,)
    np.testing.assert_array_equal(scene.gravity, [0.0, -60.0, 0.0])
    numbers = flat_numbers(material)
    found = [numbers[n] for n in ("youngs_modulus", "poissons_ratio", "density", "yield_stress")]
    np.testing.assert_allclose(found, [442413.4, 0.25, 1000.0, 3e4], rtol=1e-6)
    assert (type(material.elasticity), type(material.plasticity)) == (Hencky, VonMises)
    np.testing.assert_allclose([c.friction for c in scene.colliders], 0.9)
    np.testing.assert_allclose([c.softness for c in scene.colliders], 666.0)
    floor = scene.walls.lower[1]
    assert floor.kind is WallKind.SEPARATING and float(floor.friction) == pytest.approx(0.3)
    np.testing.assert_array_equal(PAPER.joint_start, np.zeros(24))
    np.testing.assert_allclose(PAPER.joint_step, 0.0264, rtol=1e-6)
    x = np.asarray(PAPER.rest_positions)
    assert x.shape == (8000, 3)
    np.testing.assert_allclose([x.min(0), x.max(0)], [[0.455, 0.24, 0.455], [0.545, 0.33, 0.545]], atol=1e-3)
    np.testing.assert_allclose(scene.particle_volume, 0.09**3 / 8000, rtol=1e-5)
    wrist = PAPER.poses(jnp.zeros((1, 24)))
    np.testing.assert_allclose(
        wrist.position[0, scene.colliders[0].body], [0.5, 0.2 - 0.01 * 1.5, 0.3], atol=1e-6
    )  # the hand's offset of 1 cm points down, as in HandFlip


@pytest.mark.parametrize("env", [PAPER, SMALL])
def test_reward_is_the_mean_height(env):
    x = np.asarray(env.rest_positions, np.float64) + [0.01, 0.03, 0.02]
    reward, metrics = env.reward(soft_tasks.physics(env, x))
    datum, unit = (0.0, 1.0) if env is PAPER else (0.24, 0.05)
    np.testing.assert_allclose(metrics["height"], x[:, 1].mean(), rtol=1e-6)
    np.testing.assert_allclose(reward, (x[:, 1].mean() - datum) / unit, atol=1e-5)


def test_small_draws_where_the_cube_lies():
    soft_tasks.assert_reset_noise(SMALL)


@pytest.mark.slow
def test_closing_the_hand_lifts_the_cube():
    start = soft_tasks.start("HandLift")
    closed, left = (soft_tasks.run("HandLift", start, action, 40) for action in (1.0, 0.0))
    assert float(closed[-1].metrics["height"]) > float(left[-1].metrics["height"]) + 0.03
    held = np.bitwise_or.reduce([int(s.status) for s in (*closed, *left)])
    assert held & (Status.NAN | Status.OUT_OF_DOMAIN | Status.INACTIVE_NODES) == 0


@pytest.mark.slow
def test_gradient_by_actions_is_that_of_differences(x64):
    """A small cube between the fingers, three substeps a step; joints start at limits, which are exact."""
    assert SMALL.exact_limits and not PAPER.exact_limits
    env = hand_lift.small()
    rest = lattice_box((0.5, 0.23, 0.53), (0.06, 0.04, 0.06), (4, 3, 4))
    volume = jnp.asarray(0.06 * 0.04 * 0.06 / len(rest))
    env = env.replace(
        scene=env.scene.replace(particle_volume=volume), rest_positions=rest, num_substeps=3, list_every=None
    )
    errors = difference_errors(env, num_steps=4, h=1e-7)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-4
