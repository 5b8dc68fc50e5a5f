"""SHAC: the target network, and the differences from SAPO."""

import dataclasses

import chex
import jax
import numpy as np
import pytest
from agent_cases import CASES, ENV, agent

from rewax.agents.registry import make_agent
from rewax.agents.sapo import SAPOConfig


def test_the_target_network_keeps_its_share_of_the_old_parameters():
    start, share = agent("shac").init(jax.random.key(0)), CASES["shac"].config.target_decay
    assert 0.0 < share < 1.0
    chex.assert_trees_all_equal(start.target_params, start.critic_params)
    new, _ = agent("shac").train_step(start)
    targets, critics = (
        jax.tree.map(lambda a, b: np.asarray(a - b), part, start.critic_params)
        for part in (new.target_params, new.critic_params)
    )
    chex.assert_trees_all_close(targets, jax.tree.map(lambda a: (1.0 - share) * a, critics), rtol=1e-2, atol=1e-7)
    assert max(np.abs(a).max() for a in jax.tree.leaves(targets)) > 1e-5


def test_the_targets_come_from_the_target_network_and_the_actors_return_does_not():
    """Other parameters in the target network change the critics' loss, but not the step of the actor."""
    start = agent("shac").init(jax.random.key(0))
    other = start.replace(target_params=jax.tree.map(lambda a: a + 0.3, start.target_params))
    steps = [agent("shac").train_step(state) for state in (start, other)]
    losses = [float(metrics["critic_loss"]) for _, metrics in steps]
    assert abs(losses[0] - losses[1]) > 1e-3
    chex.assert_trees_all_equal(steps[0][0].actor_params, steps[1][0].actor_params)


def test_without_entropy_and_with_its_settings_sapo_is_shac():
    """Both take the same step except for the noise of the actions: SAPO splits the key."""
    config = CASES["shac"].config
    same = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    sapo = make_agent(
        "sapo",
        ENV,
        SAPOConfig(
            **{**same, "log_std_range": (-20.0, -20.0)},
            entropy_in_return=False,
            entropy_in_targets=False,
            entropy_in_loss=False,
        ),
    )
    shac = make_agent("shac", ENV, dataclasses.replace(config, log_std_range=(-20.0, -20.0)))
    a, b = sapo.init(jax.random.key(0)), shac.init(jax.random.key(0))
    (a, _), (b, _) = sapo.train_step(a), shac.train_step(b)
    chex.assert_trees_all_close(a.actor_params, b.actor_params, rtol=1e-4, atol=1e-6)
    chex.assert_trees_all_close(a.critic_params, b.critic_params, rtol=1e-4, atol=1e-6)


def test_options_that_cannot_be():
    for change, sentence in (
        ({"target_decay": 1.5}, "target_decay is 1.5: give a number between 0 and 1, or None"),
        ({"target_value": "max"}, "target_value is 'max': use mean or min"),
        (
            {"max_env_grad_norm": -1.0},
            "max_env_grad_norm is -1.0: give a positive number, median, or None for no limit",
        ),
        (
            {"max_env_grad_norm": "mean"},
            "max_env_grad_norm is 'mean': give a positive number, median, or None for no limit",
        ),
        ({"truncate_every": 0}, "truncate_every is 0: give an integer of at least 1, or None"),
        ({"optimizer": "sgd"}, "optimizer is 'sgd': use adamw or adam"),
        (
            {"initial_log_std": -6.0},
            "initial_log_std is -6.0, but log_std_range is (-5.0, 2.0): give a number between its ends, beyond which "
            "the standard deviation learns nothing",
        ),
    ):
        with pytest.raises(ValueError) as caught:
            dataclasses.replace(CASES["shac"].config, **change)
        assert str(caught.value) == sentence
