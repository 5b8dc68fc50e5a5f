"""Returns against numbers computed by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.status import Status
from rewax.training.evaluation import episodes as evaluate


@struct.dataclass
class Ending(toys.PointMass):
    """Terminates in the step that moves beyond ``limit``; afterwards the physics blow up."""

    limit: Any

    def step(self, state, action):
        x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
        x = jnp.where(state.terminated, jnp.nan, x)
        return self.after(state, x, terminated=x[0] > self.limit)


def starts(env, key, num_episodes):
    """Initial positions that an evaluation draws."""
    keys = jax.random.split(key, num_episodes)
    return np.array([float(env.reset(jax.random.split(k)[0]).physics[0]) for k in keys])


def test_returns_of_a_constant_action_by_hand():
    env, key = toys.point_mass(length=4), jax.random.key(7)
    result = evaluate.make_evaluate(env, evaluate.constant_policy(jnp.array([0.2])), 3)(None, key)
    x0 = starts(env, key, 3)
    expected = -np.sum((x0[:, None] + 0.1 * np.arange(1, 5)) ** 2, axis=1)
    np.testing.assert_allclose(result["returns"], expected, rtol=1e-5)
    for name in ("mean", "std", "min", "max"):
        np.testing.assert_allclose(result[name], getattr(np, name)(expected), rtol=1e-4)
    np.testing.assert_array_equal(result["lengths"], [4, 4, 4])
    assert int(result["failed"]) == 0


def test_episodes_stop_counting_at_their_first_end():
    env, key = Ending(gain=jnp.float32(0.5), limit=jnp.float32(1.9), length=6), jax.random.key(1)
    result = evaluate.make_evaluate(env, evaluate.constant_policy(jnp.array([1.0])), 8)(None, key)
    for x, total, length in zip(starts(env, key, 8), result["returns"], result["lengths"], strict=True):
        path = [x + 0.5 * i for i in range(1, 7)]
        steps = next(i for i, position in enumerate(path, 1) if position > 1.9)
        assert int(length) == steps
        np.testing.assert_allclose(total, -sum(position**2 for position in path[:steps]), rtol=1e-5)
    assert len(set(result["lengths"].tolist())) > 1
    assert int(result["failed"]) == 0  # the NaN after the end is nobody's failure


@struct.dataclass
class Reviving(toys.PointMass):
    """Ends in the step that passes ``limit`` and fails there; it goes on afterwards as if nothing had happened."""

    limit: Any

    def step(self, state, action):
        x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
        passes = (x[0] > self.limit) & (state.physics[0] <= self.limit)
        beyond = state.physics[0] > self.limit
        new = self.after(state, x, terminated=passes, status=jnp.where(beyond, int(Status.CFL | Status.INVERTED), 0))
        return new.replace(status=new.status | jnp.where(passes, int(Status.NAN | Status.CFL), 0))


def test_an_episode_that_ended_never_counts_again():
    env, key = Reviving(gain=jnp.float32(0.5), limit=jnp.float32(1.9), length=6), jax.random.key(1)
    result = evaluate.make_evaluate(env, evaluate.constant_policy(jnp.array([1.0])), 8)(None, key)
    for x, total, length in zip(starts(env, key, 8), result["returns"], result["lengths"], strict=True):
        path = [x + 0.5 * i for i in range(1, 7)]
        steps = next(i for i, position in enumerate(path, 1) if position > 1.9)
        assert int(length) == steps < 6
        np.testing.assert_allclose(total, -sum(position**2 for position in path[:steps]), rtol=1e-5)
    counts = {name: int(result[f"status/{name}"]) for name in ("NAN", "CFL", "INVERTED", "OUT_OF_DOMAIN")}
    assert counts == {"NAN": 8, "CFL": 8, "INVERTED": 0, "OUT_OF_DOMAIN": 0}
    assert int(result["failed"]) == 8


def test_failures_are_counted():
    class Broken(toys.PointMass):
        def step(self, state, action):
            return self.after(state, state.physics + jnp.where(state.physics > 1.0, jnp.nan, 0.0))

    env, key = struct.dataclass(Broken)(gain=jnp.float32(0.5)), jax.random.key(2)
    result = evaluate.make_evaluate(env, evaluate.uniform_policy(env), 10)(None, key)
    expected = int(np.sum(starts(env, key, 10) > 1.0))
    assert 0 < expected < 10
    assert int(result["failed"]) == expected
    assert np.all(np.isfinite(result["returns"]))


def test_an_episode_that_fails_has_no_success():
    class Loses(toys.PointMass):
        """It is at its goal until it breaks in the fourth step; metrics then stay those of the third."""

        def step(self, state, action):
            inner = state.replace(metrics={"distance": state.metrics["distance"]})
            new = self.after(inner, state.physics + jnp.where(state.step_count == 3, jnp.nan, 0.0))
            return new.replace(metrics={**new.metrics, "success": jnp.ones(())})

        def reset(self, key):
            state = toys.PointMass.reset(self, key)
            return state.replace(metrics={**state.metrics, "success": jnp.zeros(())})

    env = struct.dataclass(Loses)(gain=jnp.float32(0.5), length=6)
    result = evaluate.make_evaluate(env, evaluate.uniform_policy(env), 4)(None, jax.random.key(0))
    assert int(result["failed"]) == 4 and float(result["success"]) == 0.0
    whole = env.replace(length=3)
    assert (
        float(evaluate.make_evaluate(whole, evaluate.uniform_policy(env), 4)(None, jax.random.key(0))["success"]) == 1.0
    )


def test_actions_without_looking_equal_the_same_constant_policy():
    env, key = toys.point_mass(length=4), jax.random.key(3)
    policy = evaluate.make_evaluate(env, evaluate.constant_policy(jnp.array([-0.3])), 5)(None, key)
    open_loop = evaluate.evaluate_actions(env, jnp.full((4, 1), -0.3), key, 5)
    np.testing.assert_allclose(open_loop["returns"], policy["returns"], rtol=1e-6)
    early = evaluate.evaluate_actions(env, jnp.array([[-1.0], [0.0], [0.0], [0.0]]), key, 5)
    np.testing.assert_allclose(early["returns"], -4 * (starts(env, key, 5) - 0.5) ** 2, rtol=1e-5)


def test_deterministic_and_sampled_differ_and_repeat():
    env = toys.point_mass()
    agent = toys.make_toy(env)
    run = evaluate.make_evaluate(env, agent.policy, 4)
    state, key = agent.init(jax.random.key(0)), jax.random.key(5)
    sampled, deterministic = run(state, key), run(state, key, deterministic=True)
    assert not np.allclose(sampled["returns"], deterministic["returns"])
    np.testing.assert_array_equal(sampled["returns"], run(state, key)["returns"])
    np.testing.assert_allclose(deterministic["returns"], -5 * starts(env, key, 4) ** 2, rtol=1e-5)


def test_help_names_every_entry_of_the_result():
    env = toys.point_mass()
    result = evaluate.make_evaluate(env, evaluate.constant_policy(jnp.zeros(1)), 2)(None, jax.random.key(0))
    for name in {name.split("/")[0] for name in result}:
        assert f"``{name}" in evaluate.make_evaluate.__doc__, name


def test_uniform_policy_fills_the_bounds():
    env = toys.point_mass()
    policy = evaluate.uniform_policy(env)
    actions = jax.vmap(lambda key: policy(None, {}, key))(jax.random.split(jax.random.key(0), 500))
    assert actions.shape == (500, 1)
    assert -1.0 <= float(actions.min()) < -0.9 and 0.9 < float(actions.max()) <= 1.0


def test_impossible_arguments_are_refused():
    env = toys.point_mass(length=4)
    with pytest.raises(ValueError, match="num_episodes is 0"):
        evaluate.make_evaluate(env, evaluate.uniform_policy(env), 0)
    with pytest.raises(ValueError, match=r"actions have shape \(3, 1\): this environment needs \(4, 1\)"):
        evaluate.evaluate_actions(env, jnp.zeros((3, 1)), jax.random.key(0), 1)


@pytest.mark.parametrize("count", [0, 1.5, "3", True])
def test_a_number_of_episodes_is_an_integer(count):
    policy, actions = evaluate.constant_policy(jnp.zeros(1)), jnp.zeros((5, 1))
    for use in (
        lambda: evaluate.make_evaluate(toys.point_mass(), policy, count),
        lambda: evaluate.make_evaluate_in(policy, count),
        lambda: evaluate.evaluate_actions(toys.point_mass(), actions, jax.random.key(0), count),
    ):
        with pytest.raises(ValueError, match=f"^num_episodes is {count!r}: give an integer of at least 1$"):
            use()
