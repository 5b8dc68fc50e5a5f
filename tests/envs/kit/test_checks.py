"""Sentences about wrong actions and keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.base import ArraySpec
from rewax.envs.kit.checks import check_action, check_key


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
