"""Functions that run on every device get arrays through their arguments only; the helpers check it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from agent_cases import CASES, agent

from rewax.agents import shac
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.devices import check_closes_over_no_array, sharded
from rewax.agents.gradients import per_env_gradients

ARRAY = jnp.ones(3)


def scaled(x, factor):
    return x * factor


class Holder:
    """An object with a method that reads an array attribute."""

    factor = 2.0

    def scaled(self, x):
        return x * self.factor


def closing_over(value):
    def inner(x):
        return x * value

    return inner


def nested(value):
    inner = closing_over(value)
    return functools.partial(lambda x, y: inner(x) + y, y=1.0)


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (closing_over(ARRAY), "value"),
        (closing_over({"a": [ARRAY]}), "value"),
        (functools.partial(scaled, factor=ARRAY), "factor"),
        (functools.partial(scaled, ARRAY), "argument 0"),
        (functools.partial(functools.partial(scaled, factor=ARRAY)), "factor"),
        (nested(ARRAY), "value"),
        (jax.vmap(closing_over(ARRAY)), "value"),
        (jax.jit(closing_over(ARRAY)), "value"),
        (lambda x, factor=ARRAY: x * factor, "default 0"),
        (functools.partial(closing_over(jax.random.key(0))), "value"),
    ],
)
def test_arrays_in_a_function_are_found(function, name):
    with pytest.raises(ValueError, match=f"closes over {name}, which holds an array: give it as an argument"):
        check_closes_over_no_array(function)


def test_what_is_known_when_the_program_is_traced_is_allowed():
    networks = make_actor_critic(toys.point_mass(), CASES["shac"].config)
    for function in (
        closing_over(2.0),
        closing_over(np.ones(3)),  # a constant of the program, as it is written
        nested((1, "a", None)),
        functools.partial(shac.actor_loss, networks=networks),
        networks.values,
        Holder().scaled,
    ):
        check_closes_over_no_array(function)


def test_a_tracer_is_found_too():
    @jax.jit
    def program(x):
        return sharded(closing_over(x), (x,), (True,))

    with pytest.raises(ValueError, match=r"closing_over.<locals>.inner closes over value"):
        program(ARRAY)
    np.testing.assert_array_equal(jax.jit(lambda x: sharded(closing_over(2.0), (x,), (True,)))(ARRAY), 2.0 * ARRAY)


def test_a_recursive_function_ends():
    def countdown(n):
        return n if n == 0 else countdown(n - 1)

    check_closes_over_no_array(countdown)


def test_gradients_of_environments_refuse_a_loss_that_closes_over_the_state():
    state = agent("shac").init(jax.random.key(0))
    networks = make_actor_critic(toys.point_mass(), CASES["shac"].config)

    def gradients(loss):
        return per_env_gradients(loss, state.actor_params, state.common(), state.environments, jax.random.key(1))

    def loss(params, common, env, env_state, key):
        del common
        return shac.actor_loss(params, state, env, env_state, key, networks=networks)

    sentence = r"loss closes over state, which holds an array: give it as an argument \(the argument `common`"
    with pytest.raises(ValueError, match=sentence):
        gradients(loss)
    losses, _, _ = jax.jit(lambda: gradients(functools.partial(shac.actor_loss, networks=networks)))()
    assert losses.shape == (4,) and np.isfinite(losses).all()
