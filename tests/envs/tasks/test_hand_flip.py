"""HandFlip: the reference's numbers, the hand's kinematics, the reward of folds, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from flat_materials import flat_numbers
from soft_tasks import assert_reset_noise, difference_errors, make

import rewax
from rewax.envs.tasks import hand_flip
from rewax.physics.mpm import Hencky, VonMises
from rewax.status import Status

PAPER = make("HandFlip", "paper")


def test_paper_has_the_references_constants():
    scene, material = PAPER.scene, PAPER.scene.material
    assert (PAPER.num_substeps, PAPER.max_steps, PAPER.cloud.num_points, PAPER.cloud.stride) == (40, 300, 250, 10)
    assert scene.dt == 5e-5 and scene.grid.spacing == 1 / 48 and PAPER.control_dt == pytest.approx(2e-3)
    np.testing.assert_array_equal(scene.gravity, [0.0, -90.0, 0.0])
    assert PAPER.rest_positions.shape == (2500, 3) and PAPER.action_spec.shape == (24,)
    np.testing.assert_allclose(scene.particle_volume, 6.104e-5, rtol=1e-3)
    numbers = flat_numbers(material)
    found = [numbers[n] for n in ("youngs_modulus", "poissons_ratio", "density", "yield_stress")]
    np.testing.assert_allclose(found, [4000.0, 0.2, 1.0, 130.0])
    assert (type(material.elasticity), type(material.plasticity)) == (Hencky, VonMises)
    np.testing.assert_allclose(PAPER.joint_step, 0.0264, rtol=1e-6)
    np.testing.assert_allclose([c.friction for c in scene.colliders], 0.5)
    np.testing.assert_allclose([c.softness for c in scene.colliders], 666.0)
    low, high = (np.asarray(a)[[0, 1, 3, 14, 19, 23]] for a in (PAPER.joint_lower, PAPER.joint_upper))
    np.testing.assert_allclose(low, [-0.489, -0.698, 0.0, 0.0, -1.047, -1.571], atol=1e-6)
    np.testing.assert_allclose(high, [0.14, 0.489, 1.571, 0.785, 1.047, 0.0], atol=1e-6)


def test_the_hand_starts_in_the_references_pose():
    """Not in its first four decimals: a fingertip would be 0.1 mm off."""
    angles = np.asarray(PAPER.joint_start)[[0, 6, 10, 22]]
    expected = [-0.16514339750464327, 0.000246444303701037, 0.00038520700007378114, -0.0015229223564485414]
    np.testing.assert_allclose(angles, expected, rtol=1e-6)


def test_the_dough_is_a_disc_of_mirror_pairs():
    x = np.asarray(PAPER.rest_positions) - [0.5, 0.38, 0.6]
    first, second = x[:1250], x[1250:]
    np.testing.assert_allclose(first * [1, 1, -1], second, atol=1e-6)
    assert (first[:, 2] >= -1e-6).all() and (np.diff(first[:, 2]) >= -1e-6).all()
    radius = np.hypot(x[:, 0], x[:, 2])
    assert radius.max() <= 0.1 + 1e-6 and np.abs(x[:, 1]).max() <= 0.003 + 1e-6
    assert np.mean(radius < 0.1 / np.sqrt(2)) == pytest.approx(0.5, abs=0.04)  # uniform in area
    distance = np.linalg.norm((first - second)[::10], axis=1).mean()
    assert distance == pytest.approx(0.0802, rel=0.08)  # twice the mean of |z|, 2 * 4 / (3 pi) * 0.1 = 0.0849


def test_reset_draws_the_references_noise():
    assert_reset_noise(PAPER)
    np.testing.assert_allclose(PAPER.noise.shift_lower, [-0.1, 0.0, -0.1])
    np.testing.assert_allclose(PAPER.noise.shift_upper, [0.1, 0.1, 0.1])
    assert float(PAPER.noise.stretch) == pytest.approx(0.05)


def hand_points(q):
    """Where the hand's geoms are, shape (num_geoms, 3)."""
    poses = jax.tree.map(lambda a: np.asarray(a)[0], jax.jit(PAPER.poses)(jnp.asarray(q, jnp.float32)[None]))
    places = [poses.position[c.body] + poses.rotation[c.body] @ np.asarray(c.offset) for c in PAPER.scene.colliders]
    return np.asarray(places)


def test_the_hand_lies_palm_up_with_fingers_along_z():
    flat = hand_points(np.zeros(24))
    scale = 2.5
    wrist = np.array([0.5, 0.30 - 0.01 * scale, 0.3])  # the wrist's offset along its y points down
    np.testing.assert_allclose(flat[0], wrist, atol=1e-5)
    palm = wrist + scale * np.array([-0.011, 0.0, 0.034 + 0.038])
    np.testing.assert_allclose(flat[1], palm, atol=1e-5)
    tip = wrist + scale * np.array([-0.033, 0.0, 0.034 + 0.095 + 0.045 + 0.025 + 0.012])
    np.testing.assert_allclose(flat[5], tip, atol=1e-5)


def test_bent_fingers_come_up_over_the_palm():
    bent = np.zeros(24)
    bent[[3, 4, 5]] = 0.5 * np.pi, 0.0, 0.0  # the first finger's knuckle, by a right angle
    knuckle = np.array([0.5, 0.275, 0.3]) + 2.5 * np.array([-0.033, 0.0, 0.129])
    np.testing.assert_allclose(hand_points(bent)[5], knuckle + [0.0, 2.5 * 0.082, 0.0], atol=1e-5)


def test_reward_is_the_share_by_which_pairs_came_closer():
    env, x = PAPER, np.array(PAPER.rest_positions)
    first = float(env.pair_distance(soft_tasks.physics(env, x, task=-jnp.ones(()))))
    folded = x.copy()
    folded[1250:] = folded[:1250] + [0.0, 0.02, 0.0]
    state = soft_tasks.physics(env, folded, task=jnp.asarray(first))
    reward, metrics = env.reward(state)
    np.testing.assert_allclose(metrics["pair_distance"], 0.02, rtol=1e-4)
    np.testing.assert_allclose(reward, (first - 0.02) / first, atol=1e-6)
    far = x * [1.0, 1.0, 10.0]
    assert float(env.reward(soft_tasks.physics(env, far, task=jnp.asarray(first)))[0]) == -1.0


def test_the_reward_is_that_of_the_same_mirror_pairs_whatever_is_observed():
    first, second = jnp.split(PAPER.observed(soft_tasks.physics(PAPER, PAPER.rest_positions)), 2)
    pairs = np.linalg.norm(first - second, axis=1).mean()
    for points in (250, 64, 33):
        env = PAPER.replace(cloud=PAPER.cloud.replace(num_points=points, stride=3, random=True, noise=0.002))
        distance = env.pair_distance(soft_tasks.physics(env, PAPER.rest_positions))
        np.testing.assert_allclose(distance, pairs, rtol=1e-6)
    with pytest.raises(ValueError, match="pair_stride is 0, but must be an integer of at least 1: give 1 for all"):
        PAPER.replace(pair_stride=0)


def test_the_first_step_sets_the_distance_and_earns_nothing():
    first, second = soft_tasks.run("HandFlip", soft_tasks.start("HandFlip"), 0.5, 2)
    assert float(soft_tasks.start("HandFlip").physics.task) < 0.0
    np.testing.assert_allclose(first.physics.task, first.metrics["pair_distance"])
    assert float(first.reward) == 0.0
    np.testing.assert_allclose(second.physics.task, first.physics.task)
    expected = (first.physics.task - second.metrics["pair_distance"]) / first.physics.task
    np.testing.assert_allclose(second.reward, expected, rtol=1e-5)


def test_closing_the_hand_folds_the_dough():
    start = soft_tasks.start("HandFlip")
    closed, left = (soft_tasks.run("HandFlip", start, action, 25)[-1] for action in (1.0, 0.0))
    assert float(closed.physics.soft.x[:, 1].mean()) > float(left.physics.soft.x[:, 1].mean()) + 0.03
    assert int(closed.status) & (Status.NAN | Status.OUT_OF_DOMAIN | Status.INACTIVE_NODES) == 0


@pytest.mark.slow
def test_gradient_by_actions_is_that_of_differences(x64):
    """64 particles between palm and two fingers, three substeps a step, all of them in pairs of the reward."""
    env = hand_flip.small(softness=60.0)
    env = env.replace(scene=env.scene.replace(colliders=env.scene.colliders[1:9]))
    rest = hand_flip.mirrored_disc((0.5, 0.30, 0.62), 0.08, 0.003, 64)
    env = env.replace(rest_positions=rest, num_substeps=3, list_every=None, pair_stride=1)
    errors = difference_errors(env, num_steps=4, h=1e-7, task=0.06)  # a D0 of its own: it has no derivative
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-4


def test_particles_without_mirror_images_are_refused():
    env = rewax.make("HandFlip", scale="small")
    assert env.replace(rest_positions=env.rest_positions + 0.01).pair_stride == env.pair_stride
    for positions in (env.rest_positions[:-1], env.rest_positions[::-1].at[0, 0].add(0.01)):
        with pytest.raises(ValueError, match="does not mirror the first"):
            env.replace(rest_positions=positions)
