"""Sentences about wrong actions and keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.base import ArraySpec
from rewax.envs.kit.checks import (
    check_key,
    check_keys,
    checked_action,
    checked_control,
    checked_next_task,
    checked_observation,
    checked_poses,
    checked_reward,
    checked_start,
    checked_terminated,
)
from rewax.physics.numerics import Pose


@pytest.mark.parametrize("action", [np.zeros(3), jnp.zeros(3), [0.0, 1.0, 2.0]])
def test_actions_of_the_right_shape_pass(action):
    np.testing.assert_array_equal(checked_action(action, ArraySpec((3,))), np.asarray(action))


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
        checked_action(jnp.zeros(shape), ArraySpec((3,)))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "action", [["a"], "a", None, [1j], jnp.ones(1, complex), [[0.0], [0.0, 1.0]], {"a": 0.0}], ids=str
)
def test_actions_that_are_no_real_numbers_are_refused(action):
    with pytest.raises(
        ValueError, match=r"^the action is .*, which is no array of real numbers: give an array of shape "
    ):
        checked_action(action, ArraySpec((1,)))


@pytest.mark.parametrize("key", [7, jax.random.key(0), jax.random.PRNGKey(0)], ids=str)
def test_a_batch_needs_a_key_for_each_environment(key):
    with pytest.raises(ValueError, match=r"^the key is .*: give one for each environment, jax.random.split\("):
        check_keys(key)
    check_keys(jax.random.split(jax.random.key(0), 3))
    check_keys(np.zeros((3, 2), np.uint32))


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


POSE = Pose(jnp.zeros((9, 1, 3)), jnp.zeros((9, 1, 3, 3)))
PARTS = {"the pose": Pose}


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
            lambda task: checked_start(task, jnp.zeros(3), PARTS),
            "Task.start returned an array of float32 of shape (3,): return the pose and the state of the task, which may "
            "be None",
        ),
        (
            lambda task: checked_start(task, (None, None), PARTS),
            "Task.start returned None for the pose, which must be a Pose: return the pose and",
        ),
        (
            lambda task: checked_start(task, (POSE, {"goal": "a"}), PARTS),
            "Task.start returned 'a' in the state of the task: keep arrays there, or None",
        ),
        (
            lambda task: checked_next_task(task, None, jnp.zeros(3)),
            "Task.next_task returned None after an array of float32 of shape (3,): return the arrays that start returned",
        ),
        (
            lambda task: checked_next_task(task, {"a": jnp.zeros(2)}, {"a": jnp.zeros(())}),
            "Task.next_task returned shape (2,) after (): keep the shape",
        ),
        (lambda task: checked_poses(task, None, 9), "Task.poses returned None: return a Pose of shapes (9, num_bodies"),
        (lambda task: checked_control(task, None), "Task.control returned None: return one number for each actuator"),
        *(
            (
                lambda task, wrong=wrong: checked_terminated(task, wrong),
                f"Task.terminated returned {said}: return one boolean, physics.rigid.qpos[0] > 1.0 for example",
            )
            for wrong, said in [
                (1, "1"),
                (None, "None"),
                (0.5, "0.5"),
                (jnp.zeros(1, bool), "an array of bool of shape (1,)"),
                (jnp.zeros(()), "an array of float32 of shape ()"),
            ]
        ),
        *(
            (
                lambda task, wrong=wrong: checked_observation(task, {"a": wrong}),
                "Task.observe(physics)['a'] is ",
            )
            for wrong in ({"b": 1.0}, None, "x", 1j, jnp.ones(2, complex))
        ),
        (lambda task: checked_observation(task, {3: 1.0}), "Task.observe(physics) has the name 3: use text for names"),
        (lambda task: checked_reward(task, (None, {})), "Task.reward(physics)[0] is None, which is no array of real"),
        (lambda task: checked_reward(task, (1j, {})), "Task.reward(physics)[0] is 1j, which is no array of real"),
        (
            lambda task: checked_reward(task, (1.0, {"a": "b"})),
            "Task.reward(physics)[1]['a'] is 'b', which is no array",
        ),
        (lambda task: checked_reward(task, (1.0, {"a": None})), "Task.reward(physics)[1]['a'] is None, which is no"),
        (lambda task: checked_reward(task, (1.0, {1: 0.0})), "Task.reward(physics)[1] has the name 1: use text for"),
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
    assert str(error.value).startswith(sentence) and ": " in str(error.value) and "\n" not in str(error.value)


def test_what_a_task_returns_rightly_passes():
    task = Task()
    assert checked_poses(task, POSE, 9) is POSE
    assert checked_reward(task, (0.5, {"speed": jnp.zeros(())}))[0] == 0.5
    assert checked_start(task, (POSE, None), PARTS) == (POSE, None)
    assert checked_start(task, (POSE, {"goal": 0.0}), PARTS)[1] == {"goal": 0.0}
    observed = checked_observation(task, {"x": jnp.zeros(2), "list": [1.0, jnp.ones(())], "touches": jnp.bool_(True)})
    assert [value.shape for value in observed.values()] == [(2,), (2,), ()] and observed["touches"].dtype == bool
    assert checked_terminated(task, True) and checked_terminated(task, np.True_)
    assert checked_next_task(task, {"a": jnp.ones(2)}, {"a": jnp.zeros(2)})["a"].shape == (2,)


def test_checks_add_no_operation_to_a_program():
    def checked(x):
        task = Task()
        reward, metrics = checked_reward(task, (x[0], {"x": x[1]}))
        obs = checked_observation(task, {"x": x})
        action = checked_action(x, ArraySpec((2,)))
        return reward, metrics, obs, action, checked_next_task(task, x, x), checked_terminated(task, x[0] > 0)

    def plain(x):
        return x[0], {"x": x[1]}, {"x": x}, x, x, x[0] > 0

    assert str(jax.make_jaxpr(checked)(jnp.ones(2))) == str(jax.make_jaxpr(plain)(jnp.ones(2)))
