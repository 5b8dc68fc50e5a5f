"""check_agent passes sound agents and names what is wrong with a broken one."""

import itertools
from typing import Any, NamedTuple

import agent_cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.testing import agent_policy, agent_states, check_agent

ENV = toys.point_mass()
TOY = toys.make_toy(ENV)
COUNTER = itertools.count()


class Plain(NamedTuple):
    iteration: Any = 0


def squashed(ts, obs, key, deterministic=False):
    return jnp.tanh(TOY.policy(ts, obs, key, deterministic))


SOUND = TOY._replace(policy=squashed)


def init_with(change):
    """An ``init`` followed by ``change(state, key)``."""
    return SOUND._replace(init=lambda key: change(TOY.init(key), key))


def step_with(change):
    """A ``train_step`` followed by ``change(new_state, metrics, old_state)``."""
    return SOUND._replace(train_step=jax.jit(lambda ts: change(*TOY.train_step(ts), ts)))


def metric_with(**changes):
    return step_with(lambda new, metrics, old: (new, {**metrics, **changes}))


def without(metrics, name):
    return {key: value for key, value in metrics.items() if key != name}


def calling_back(new, metrics, old):
    """An iteration that depends on how often it ran."""
    count = jax.pure_callback(
        lambda: np.float32(next(COUNTER)), jax.ShapeDtypeStruct((), jnp.float32), vmap_method="sequential"
    )
    return new.replace(bias=new.bias + count), metrics


def counting(new, metrics, old):
    """An iteration that depends on how often it was traced."""
    return new.replace(bias=new.bias + next(COUNTER)), metrics


def deciding(ts):
    new, metrics = TOY.train_step(ts)
    return (new, metrics) if ts.iteration >= 0 else (ts, metrics)


@jax.custom_batching.custom_vmap
def less_the_mean(x):
    return x


@less_the_mean.def_vmap
def _(axis_size, batched, x):
    return x - jnp.mean(x) - 1.0, True


def donating(ts):
    return TOY.train_step(ts)


def names_by_count(ts):
    """Metrics whose names depend on the iteration; never compiled, so that it can."""
    new, metrics = TOY.train_step(ts)
    traced = isinstance(ts.iteration, jax.core.Tracer)
    return new, metrics if traced or int(ts.iteration) == 0 else {**metrics, "late": new.bias[0]}


def acting(act):
    """A policy ``act(ts, obs, key, deterministic)``."""
    return SOUND._replace(policy=lambda ts, obs, key, deterministic=False: act(ts, obs, key, deterministic))


BROKEN = {
    r"^agent has no function policy: give a rewax.agents.base.Agent\(init=..., train_step=..., policy=...\)$": SOUND._replace(
        policy=None
    ),
    r"^.iteration of the state has type int: let init return arrays only$": SOUND._replace(init=lambda key: Plain()),
    r"^the state has no field env_steps: add it, jnp.int32\(0\) at first$": SOUND._replace(
        init=lambda key: Plain(iteration=jnp.int32(0))
    ),
    r"^iteration of the state is float32\(\): let it be int32\(\)$": init_with(
        lambda ts, key: ts.replace(iteration=jnp.zeros(()))
    ),
    r"^env_steps is 7 after init: begin with 0$": init_with(lambda ts, key: ts.replace(env_steps=jnp.int32(7))),
    r"^two calls of init with one key differ in .bias of the state: let init depend on its key: no Python state": init_with(
        lambda ts, key: ts.replace(bias=ts.bias + next(COUNTER))
    ),
    r"^init gives the same state for different keys: draw parameters and environments from the key$": SOUND._replace(
        init=lambda key: TOY.init(jax.random.key(0))
    ),
    r"^train_step cannot be compiled \(.*\): use jnp.where or lax.cond instead of if": SOUND._replace(
        train_step=deciding
    ),
    r"^train_step returns no pair: return \(state, metrics\)$": SOUND._replace(
        train_step=lambda ts: TOY.train_step(ts)[0]
    ),
    r"^the state of train_step has another structure than that of init": step_with(
        lambda new, metrics, old: (new.replace(memory=None), metrics)
    ),
    r"^.bias of the state is float32\(1,\) after init, float16\(1,\) after train_step: a scan needs them the same$": step_with(
        lambda new, metrics, old: (new.replace(bias=new.bias.astype(jnp.float16)), metrics)
    ),
    r"^.bias of the state is float32\(1,\) \(weakly typed\) after init, float32\(1,\) after train_step": step_with(
        lambda new, metrics, old: (new.replace(bias=new.bias + jnp.zeros(1, jnp.float32)), metrics)
    )._replace(init=lambda key: TOY.init(key).replace(bias=jnp.full(1, 0.0))),
    r"^train_step consumes its input: give the Agent consumes=True, or donate nothing$": SOUND._replace(
        init=jax.jit(TOY.init), train_step=jax.jit(donating, donate_argnums=0)
    ),
    r"^metrics of the first and the second iteration differ in \['late'\]: give the same names always$": SOUND._replace(
        train_step=names_by_count
    ),
    r"^iteration is 0 after train_step number 1: add 1 in each$": step_with(
        lambda new, metrics, old: (new.replace(iteration=old.iteration), metrics)
    ),
    r"^env_steps is 5, then 5 after two calls of train_step: add the control steps": step_with(
        lambda new, metrics, old: (new.replace(env_steps=jnp.int32(5)), metrics)
    ),
    r"^metrics lack 'failed_env', which the training loop reads: add those of RunState.after": step_with(
        lambda new, metrics, old: (new, without(metrics, "failed_env"))
    ),
    r"^metrics lack 'failed_env', 'failed_leaf', which the training loop reads": step_with(
        lambda new, metrics, old: (new, without(without(metrics, "failed_env"), "failed_leaf"))
    ),
    r"^metric 'alpha' has shape \(2,\): it must be a scalar$": metric_with(alpha=jnp.zeros(2)),
    r"^metric 'alpha' is nan: look for a mean over nothing or a division by 0, or name it in may_be_nan": metric_with(
        alpha=jnp.float32(jnp.nan)
    ),
    r"^metric 'return' is inf: look for": metric_with(**{"return": jnp.float32(jnp.inf)}),
    r"^two iterations from one state differ in .bias of the state: let it depend on its state: no Python": step_with(
        calling_back
    ),
    r"^train_step and the same traced once more differ in .bias of the state: let train_step depend": step_with(
        counting
    ),
    r"^vmap over seeds, and a run alone, differ in .bias of the state: let a run depend on its own state only; rounding does it, too, where chaotic episodes amplify it: ": step_with(
        lambda new, metrics, old: (new.replace(bias=less_the_mean(new.bias)), metrics)
    ),
    r"^policy\(..., deterministic=True\) gives different actions for different keys: return the mode": acting(
        lambda ts, obs, key, deterministic: squashed(ts, obs, key)
    ),
}

BROKEN_POLICIES = {
    r"^policy\(..., deterministic=False\) returns shape \(2,\), action_spec has \(1,\): return the action of one": acting(
        lambda ts, obs, key, deterministic: jnp.zeros(2)
    ),
    r"^policy\(..., deterministic=False\) returns dtype int32: use a float$": acting(
        lambda ts, obs, key, deterministic: jnp.zeros(1, jnp.int32)
    ),
    r"^policy\(..., deterministic=False\) returns an action that is not finite: \[nan\]$": acting(
        lambda ts, obs, key, deterministic: jnp.full(1, jnp.nan)
    ),
    r"^policy\(..., deterministic=True\) returns an action beyond the bounds of its spec \[-1.0, 1.0\]: \[3.\]; squash": acting(
        lambda ts, obs, key, deterministic: jnp.full(1, 3.0 if deterministic else 0.0)
    ),
    r"^two calls of policy\(..., deterministic=False\) differ in  of the action: let the action depend": acting(
        lambda ts, obs, key, deterministic: jnp.full(1, 0.5 / (1 + next(COUNTER)))
    ),
    r"^vmap\(policy\(..., deterministic=False\)\) cannot be compiled": acting(
        lambda ts, obs, key, deterministic: ts.bias if obs["x"][0] > 0 else -ts.bias
    ),
}


def test_a_sound_agent_passes():
    lines = []
    check_agent(SOUND, ENV, notify=lines.append)
    assert lines[0].startswith("check_agent, ") and lines[0].endswith(" s: compiling init and train_step")
    assert lines[-1].endswith(" s: passed")


def test_a_metric_that_an_iteration_may_lack_is_named_by_the_user():
    check_agent(metric_with(alpha=jnp.float32(jnp.nan)), ENV, may_be_nan=("return", "alpha"), notify=None)


@pytest.mark.parametrize("sentence", BROKEN, ids=range(len(BROKEN)))
def test_a_broken_agent_is_named(sentence):
    with pytest.raises(AssertionError, match=sentence) as caught:
        check_agent(BROKEN[sentence], ENV, notify=None)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("sentence", BROKEN_POLICIES, ids=range(len(BROKEN_POLICIES)))
def test_a_broken_policy_is_named(sentence):
    agent, key = BROKEN_POLICIES[sentence], jax.random.key(0)
    with pytest.raises(AssertionError, match=sentence) as caught:
        agent_policy.check_policy(agent, ENV, agent.init(key), key, tolerance=1e-2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["sac", "apg"])
def test_algorithms_of_the_package_pass(name):
    """One that consumes its input; one that is first-order."""
    check_agent(agent_cases.agent(name), ENV, notify=None)


def test_a_gradient_that_is_not_finite_must_not_reach_the_parameters():
    agent = agent_cases.agent("apg")

    def poisoned(state):
        new, metrics = agent.train_step(state)
        physics = new.environments.state.physics - new.environments.state.physics
        spoilt = jnp.sum(state.environments.state.physics * 0.0) + jnp.sum(physics)
        return new.replace(actor_params=jax.tree.map(lambda a: a + spoilt, new.actor_params)), metrics

    with pytest.raises(AssertionError, match=r"^one environment failed, and \.actor_params.* is not finite after"):
        agent_states.check_failure(agent._replace(train_step=jax.jit(poisoned)), jax.random.key(0))


@pytest.mark.parametrize("name", ["failed_episodes", "status/NAN"])
def test_a_failure_must_be_counted(name):
    agent = agent_cases.agent("apg")

    def hiding(state):
        new, metrics = agent.train_step(state)
        return new, {**metrics, name: 0 * metrics[name]}

    with pytest.raises(AssertionError, match=rf"^metric '{name}' is 0 though the physics of an environment became NaN"):
        agent_states.check_failure(agent._replace(train_step=jax.jit(hiding)), jax.random.key(0))
