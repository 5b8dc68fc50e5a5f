"""Sentences about wrong actions and keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.base import ArraySpec
from rewax.envs.kit.checks import (
    check_action,
    check_key,
    checked_observation,
    checked_poses,
    checked_reward,
    checked_start,
)
from rewax.physics.numerics import Pose


@pytest.mark.parametrize("action", [np.zeros(3), jnp.zeros(3), [0.0, 1.0, 2.0]])
def test_actions_of_the_right_shape_pass(action):
    check_action(action, ArraySpec((3,)))


@pytest.mark.parametrize("key", [jax.random.key(0), jax.random.PRNGKey(0), np.asarray([0, 1], np.uint32)])
def test_single_keys_pass(key):
    check_key(key)


def test_traced_keys_pass_alone_and_under_vmap():
    jax.eval_shape(check_key, jax.random.key(0))
    jax.vmap(lambda key: (check_key(key), jnp.zeros(()))[1])(jax.random.split(jax.random.key(0), 3))


@pytest.mark.parametrize("shape", [(), (1, 3), (2,)])
def test_actions_of_another_shape_are_refused(shape):
    with pytest.raises(
        ValueError, match=r"^the action has shape .*: give shape \(3,\), and jax\.vmap over step"
    ) as error:
        check_action(jnp.zeros(shape), ArraySpec((3,)))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("key", "said"),
    [
        (7, "7"), (True, "True"), ("a", "'a'"), (jnp.int32(3), r"an array of int32 of shape \(\)"),
        (np.zeros(2), r"an array of float64 of shape \(2,\)"), ([0, 1], "a list"),
    ],
)  # fmt: skip
def test_what_is_no_key_is_refused(key, said):
    sentence = rf"^the key is {said}: give a random key, jax\.random\.key\(0\) for example$"
    with pytest.raises(ValueError, match=sentence):
        check_key(key)


@pytest.mark.parametrize("key", [jax.random.split(jax.random.key(0), 4), np.zeros((4, 2), np.uint32)])
def test_several_keys_are_refused(key):
    with pytest.raises(
        ValueError, match=r"^the key holds keys of shape \(4,\): give one key, and jax\.vmap over reset"
    ):
        check_key(key)


class Task:
    """Only its name counts."""


@pytest.mark.parametrize(
    ("check", "sentence"),
    [
        (
            lambda task: checked_observation(task, jnp.zeros(3)),
            'Task.observe returned an array of float32 of shape (3,): return a dict of arrays, {"state": ...} for example',
        ),
        (lambda task: checked_observation(task, {}), "Task.observe returned a dict: return a dict of arrays"),
        (
            lambda task: checked_reward(task, jnp.zeros(())),
            "Task.reward returned an array of float32 of shape (): return the reward and a dict of scalars to log",
        ),
        (lambda task: checked_reward(task, (1.0, {}, 2)), "Task.reward returned a tuple of 3: return the reward and"),
        (
            lambda task: checked_reward(task, (jnp.zeros(2), {})),
            "Task.reward returned the reward of shape (2,): return scalars, of shape ()",
        ),
        (
            lambda task: checked_reward(task, (0.0, {"speed": jnp.zeros(3)})),
            "Task.reward returned 'speed' of shape (3,): return scalars, of shape ()",
        ),
        (
            lambda task: checked_start(task, jnp.zeros(3), ("the bodies", "what the task keeps")),
            "Task.start returned an array of float32 of shape (3,): return the bodies and what the task keeps, which may "
            "be None",
        ),
        (
            lambda task: checked_poses(task, Pose(jnp.zeros((9, 3)), jnp.zeros((9, 3, 3))), 9),
            "Task.poses returned positions of shape (9, 3) and rotations of shape (9, 3, 3) for 9 moments: return shapes "
            "(9, num_bodies, 3) and (9, num_bodies, 3, 3), also for one body",
        ),
    ],
)
def test_what_a_task_returns_wrongly_is_one_sentence(check, sentence):
    with pytest.raises(ValueError) as error:
        check(Task())
    assert str(error.value).startswith(sentence) and "\n" not in str(error.value)


def test_what_a_task_returns_rightly_passes():
    task, pose = Task(), Pose(jnp.zeros((9, 1, 3)), jnp.zeros((9, 1, 3, 3)))
    assert checked_poses(task, pose, 9) is pose
    assert checked_reward(task, (0.5, {"speed": jnp.zeros(())}))[0] == 0.5
    assert checked_start(task, (1, None), ("the bodies", "what the task keeps")) == (1, None)
    assert list(checked_observation(task, {"x": jnp.zeros(2)})) == ["x"]
