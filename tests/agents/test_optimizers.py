"""Learning rates and clipping."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from rewax.agents.optimizers import Packing, apply, clipped_adamw, finite_or_zero, linear_fall, schedule_at

ADAM = {"b1": 0.7, "b2": 0.95, "weight_decay": 0.01, "max_grad_norm": 0.5}


def step_sizes(optimizer, num):
    """Step sizes of Adam for a gradient that is always the same, without weights that decay."""
    params, grad = jnp.zeros(2), jnp.ones(2)

    def one(state, _):
        update, state = optimizer.update(grad, state, params)
        return state, -update[0]

    return np.asarray(jax.lax.scan(one, optimizer.init(params), None, length=num)[1])


def test_learning_rates_fall_linearly_and_then_stay():
    done = np.minimum(np.arange(14) / 10, 1.0)
    falling = clipped_adamw(linear_fall(1e-2, 1e-3, 10), **ADAM)
    np.testing.assert_allclose(step_sizes(falling, 14), 1e-2 + (1e-3 - 1e-2) * done, rtol=1e-4)
    often = clipped_adamw(linear_fall(5e-3, 1e-3, 10, updates_per_iteration=4), **ADAM)
    expected = np.repeat(5e-3 + (1e-3 - 5e-3) * done, 4)
    np.testing.assert_allclose(step_sizes(often, 14 * 4), expected, rtol=1e-4)
    np.testing.assert_allclose(step_sizes(clipped_adamw(5e-3, **ADAM), 14), 5e-3, rtol=1e-4)


def test_a_learning_rate_below_the_last_one_does_not_rise():
    constant = clipped_adamw(linear_fall(1e-3, 1e-2, 10), **ADAM)
    np.testing.assert_allclose(step_sizes(constant, 14), 1e-3, rtol=1e-4)


def test_a_learning_rate_can_be_set_to_that_of_another_update():
    falling = clipped_adamw(linear_fall(1e-2, 1e-3, 10, updates_per_iteration=2), **ADAM)
    params = {"a": jnp.zeros(2), "b": jnp.zeros(1)}
    state = falling.init(params)
    moved = schedule_at(state, jnp.asarray(10))
    update, _ = falling.update(jax.tree.map(jnp.ones_like, params), moved, params)
    np.testing.assert_allclose(update["a"], -(1e-2 + 1e-3) / 2, rtol=1e-4)  # half of the iterations
    assert int(moved[1].count) == 0  # Adam's own count, which corrects its moments
    jax.tree.map(np.testing.assert_array_equal, schedule_at(moved, jnp.asarray(0)), state)


def test_the_norm_over_everything_is_clipped():
    params = {"a": jnp.zeros(2), "b": jnp.zeros(1)}
    optimizer = clipped_adamw(0.1, **{**ADAM, "max_grad_norm": 0.5})
    grad = {"a": jnp.array([3.0, 0.0]), "b": jnp.array([4.0])}
    _, state = apply(optimizer, grad, optimizer.init(params), params)
    moment = state[1].mu  # (1 - b1) of the clipped gradient
    np.testing.assert_allclose([moment["a"][0], moment["b"][0]], [0.3 * 0.3, 0.3 * 0.4], rtol=1e-5)


def test_weights_decay_even_without_a_gradient():
    optimizer = clipped_adamw(0.1, **ADAM)
    params = jnp.array([2.0])
    new, _ = apply(optimizer, jnp.zeros(1), optimizer.init(params), params)
    np.testing.assert_allclose(new, 2.0 * (1 - 0.1 * 0.01), rtol=1e-6)


PARAMS = {
    "layers": [{"w": jnp.arange(6.0).reshape(2, 3), "b": jnp.array([7.0, -1.0])}, {"w": jnp.ones((1, 2, 2))}],
    "scale": jnp.float32(3.0),
}


def test_packed_parameters_come_back_as_they_were():
    packing = Packing(PARAMS)
    trap = jnp.arange(13.0)  # as long as the parameters, but not made of them
    tree = (PARAMS, {"mu": jax.tree.map(lambda a: 2 * a, PARAMS), "trap": trap, "count": jnp.int32(4)})
    packed = packing.pack(tree)
    assert [leaf.shape for leaf in jax.tree.leaves(packed)] == [(13,), (), (13,), (13,)]
    back = packing.unpack(packed)
    assert jax.tree.structure(back) == jax.tree.structure(tree)
    jax.tree.map(np.testing.assert_array_equal, back, tree)


def test_what_gains_nothing_or_would_lose_its_types_is_not_packed():
    assert Packing(jnp.ones(3)).pack(jnp.ones(3)).shape == (3,)
    mixed, same = {"a": jnp.ones(2), "b": jnp.ones(2, jnp.bfloat16)}, {"a": jnp.ones(2), "b": jnp.ones(2)}
    for params, part in ((mixed, mixed), (mixed, same), (same, mixed)):
        assert jax.tree.structure(Packing(params).pack(part)) == jax.tree.structure(part)


@pytest.mark.parametrize(
    "optimizer", [clipped_adamw(0.1, **ADAM), optax.adam(optax.constant_schedule(0.1)), optax.sgd(0.1)]
)
def test_an_update_is_that_of_the_parameters_apart(optimizer):
    grad = jax.tree.map(lambda a: jnp.cos(a) + a, PARAMS)
    params, state = PARAMS, optimizer.init(PARAMS)
    for _ in range(3):
        updates, expected_state = optimizer.update(grad, state, params)
        expected = optax.apply_updates(params, updates)
        params, state = apply(optimizer, grad, state, params)
        assert jax.tree.structure((params, state)) == jax.tree.structure((expected, expected_state))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), params, expected)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), state, expected_state)


def test_an_update_can_be_longer_or_shorter():
    optimizer = optax.sgd(0.1)
    new, _ = apply(optimizer, PARAMS, optimizer.init(PARAMS), PARAMS, scale=0.5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, 0.95 * b, rtol=1e-6), new, PARAMS)


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf, -jnp.inf])
def test_single_numbers_that_are_not_finite_become_zero(bad):
    np.testing.assert_array_equal(finite_or_zero(jnp.array([1.0, bad, -2.0])), [1.0, 0.0, -2.0])
