"""SAPO from demonstrations: two phases share one budget of steps, and the policy imitates the sequence."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from agent_cases import CASES, ENV, agent

from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.demonstrated import DemonstratedConfig, clone, cloning_loss, make_demonstrated, on_schedule
from rewax.agents.presets import demonstrated_preset, sapo_preset
from rewax.agents.registry import make_agent
from rewax.agents.rollout import Transition, first_episode
from rewax.envs import make

NAME = "sapo_from_demonstrations"


def test_both_phases_have_as_many_steps_as_sapo():
    """With sequences of 5 steps and iterations of 4; and on HandFlip, with episodes of 60 steps and iterations of 16."""
    config = DemonstratedConfig(num_envs=4, horizon=4, num_iterations=10, demonstration_share=0.5)
    assert config.demonstrations(ENV) == 4 and config.second_phase(ENV).num_iterations == 5
    hand, env = demonstrated_preset("HandFlip", "small"), make("HandFlip", scale="small")
    steps = hand.demonstrations(env) * env.episode_length + hand.second_phase(env).num_iterations * hand.horizon
    assert steps == sapo_preset("HandFlip", "small").num_iterations * hand.horizon
    changed = dataclasses.asdict(hand.second_phase(env)) | {"num_iterations": 120, "initial_log_std": 0.0}
    assert changed == dataclasses.asdict(sapo_preset("HandFlip", "small"))


def test_the_policy_does_what_the_sequence_does_when_the_second_phase_begins():
    """The best sequence moves by -1, -1, 0, 0, 0. The policy observes the position, which identifies the step."""
    state, one = agent(NAME).init(jax.random.key(0)), CASES[NAME].config.demonstrations(ENV)
    for _ in range(one):
        state, metrics = agent(NAME).train_step(state)
        assert np.isnan(metrics["entropy"]) and np.isfinite(metrics["cloning_loss"])
    x, key = jnp.ones(1), jax.random.key(0)
    for action in state.actions[:2]:
        chosen = agent(NAME).policy(state, {"x": x}, key, deterministic=True)
        np.testing.assert_allclose(chosen, action, atol=0.25)
        x = x + 0.5 * action
    assert int(state.env_steps) == one * 5 * 4
    before = state.actions
    counts = lambda: {int(a) for a in jax.tree.leaves(state.critic_opt) if a.dtype == jnp.int32}  # noqa: E731
    config = CASES[NAME].config
    each = config.critic_passes * config.critic_minibatches
    assert counts() == {one * each}
    state, metrics = agent(NAME).train_step(state)
    assert counts() == {each}, "the critics' learning rate begins anew"
    assert int(state.env_steps) == one * 5 * 4 + 4 * 4 and np.isfinite(metrics["entropy"])
    np.testing.assert_array_equal(state.actions, before)


def test_a_run_with_more_iterations_stays_in_its_second_phase():
    """With 40 iterations instead of 10 the first phase would have 16 instead of 4."""
    config = CASES[NAME].config
    state, one = agent(NAME).init(jax.random.key(0)), config.demonstrations(ENV)
    for _ in range(one + 1):
        state, _ = agent(NAME).train_step(state)
    longer = dataclasses.replace(config, num_iterations=4 * config.num_iterations)
    assert int(state.iteration) == one + 1 < longer.demonstrations(ENV)
    new, metrics = make_agent(NAME, ENV, longer).train_step(state)
    np.testing.assert_array_equal(new.actions, state.actions)
    assert np.isfinite(metrics["entropy"]) and np.isnan(metrics["cloning_loss"])
    each = config.critic_passes * config.critic_minibatches
    assert counts_of(new) == [1, each], "240 of 420 iterations were planned, so one is less than one of the schedule"


def counts_of(state):
    """Numbers of updates from which the learning rates of actor and critics follow."""
    is_schedule = lambda part: isinstance(part, optax.ScaleByScheduleState)  # noqa: E731
    leaves = jax.tree.leaves((state.actor_opt, state.critic_opt), is_leaf=is_schedule)
    return [int(part.count) for part in leaves if is_schedule(part)]


def test_learning_rates_of_a_longer_run_fall_until_its_end():
    """Of 40 iterations of 4 steps, 35 are left after a first phase of 4 sequences of 5 steps, and 20 were planned."""
    config = dataclasses.replace(CASES[NAME].config, num_iterations=40)
    assert config.second_phase(ENV).num_iterations == 20
    state = agent(NAME).init(jax.random.key(0))
    each = config.critic_passes * config.critic_minibatches

    def after(first, second):
        opt = jax.tree.map(lambda a: jnp.full_like(a, first) if a.dtype == jnp.int32 else a, state.actions_opt)
        return on_schedule(config, state.replace(actions_opt=opt, iteration=jnp.asarray(first + second, jnp.int32)))

    assert [counts_of(after(4, n)) for n in (0, 7, 35)] == [[0, 0], [4, 4 * each], [20, 20 * each]]
    planned = config.demonstrations(ENV)
    assert [counts_of(after(planned, n)) for n in (0, 7, 20)] == [[0, 0], [7, 7 * each], [20, 20 * each]]


def test_cloning_loss_is_a_mean_squared_error():
    config = CASES[NAME].config
    networks = make_actor_critic(ENV, config.second_phase(ENV))
    params = networks.network.init(jax.random.key(0), {"x": jnp.zeros(1)})
    obs, actions = {"x": jnp.array([[0.3], [-0.8], [9.0]])}, jnp.array([[0.5], [-0.2], [jnp.nan]])
    counts = jnp.array([True, True, False])
    policies = [networks.distribution(params, {"x": x}) for x in obs["x"][:2]]
    expected = [
        (float(jnp.tanh(p.mean[0])) - a) ** 2 + (float(p.log_std[0]) + 1.0) ** 2
        for p, a in zip(policies, (0.5, -0.2), strict=True)
    ]
    loss = cloning_loss(params, obs, actions, counts, networks=networks)
    np.testing.assert_allclose(loss, np.mean(expected), rtol=1e-5)


def test_actions_after_the_end_of_an_episode_are_not_imitated():
    """The sequence was optimised from the first state of the episode, not from the state after a reset."""
    config, state = CASES[NAME].config, agent(NAME).init(jax.random.key(0))
    networks = make_actor_critic(ENV, config.second_phase(ENV))
    zeros, over = jnp.zeros((2, 4)), jnp.zeros((2, 4), bool).at[:, 1].set(True)

    def fitted(actions):
        transitions = Transition(
            obs={"x": jnp.linspace(-1.0, 1.0, 8).reshape(2, 4, 1)}, action=actions[..., None], reward=zeros,
            next_obs={"x": zeros[..., None]}, terminated=over, truncated=jnp.zeros_like(over),
            status=zeros.astype(jnp.int32), failed_leaf=zeros.astype(jnp.int32), metrics={}, aux={},
            active=jnp.ones_like(over),
        )  # fmt: skip
        return jax.tree.leaves(clone(config, networks, state, first_episode(transitions))[0].actor_params)

    plain, later, earlier = (fitted(zeros.at[:, step].set(value)) for step, value in ((1, 0.0), (2, 0.9), (1, 0.9)))
    for a, b in zip(plain, later, strict=True):
        np.testing.assert_array_equal(a, b)
    assert any(np.abs(a - b).max() > 1e-4 for a, b in zip(plain, earlier, strict=True))


def test_minibatches_that_do_not_fit_an_episode_are_refused():
    config = DemonstratedConfig(num_envs=4, horizon=4, critic_minibatches=8)
    with pytest.raises(ValueError, match="does not divide num_envs \\* episode length = 20"):
        make_demonstrated(ENV, config)


def test_a_run_without_time_for_a_demonstration_says_so():
    config = dataclasses.replace(CASES[NAME].config, num_iterations=1)
    with pytest.warns(UserWarning, match="less than an episode of 5, so this is SAPO without demonstrations"):
        make_demonstrated(ENV, config)
