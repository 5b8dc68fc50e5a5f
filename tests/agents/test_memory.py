"""Policies with memory: gradients through time, sequences that are recomputed, runs that go on to the bit."""

import functools

import jax
import jax.numpy as jnp
import memory_toys
import numpy as np
import pytest
import toys
from agent_cases import assert_same_bits

import rewax
from rewax.agents import ppo, shac
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.registry import algorithm
from rewax.agents.run_state import partition
from rewax.agents.sapo import make_sapo
from rewax.envs import AutoReset
from rewax.envs.leaves import EnvLeaves
from rewax.envs.memory import MEMORY, action_of, remembering, stage
from rewax.training.evaluation.episodes import make_evaluate
from rewax.training.evaluation.programs import MODES, any_of
from rewax.training.storage import checkpoint

SIZE = memory_toys.SIZE
ENV = memory_toys.shown_once()


@functools.cache
def agent(name):
    return memory_toys.agent(name)


def after(agent, state, iterations):
    for _ in range(iterations):
        state, _ = agent.train_step(state)
    return state


@pytest.mark.parametrize(
    "name", ["ppo", "sapo", *(pytest.param(n, marks=pytest.mark.slow) for n in ("shac", "rpo", "ahac", "apg"))]
)
def test_a_resumed_run_is_the_same_to_the_bit_and_its_memory_goes_on(name, tmp_path):
    half = after(agent(name), agent(name).init(jax.random.key(0)), 2)
    memory = half.environments.state.obs[MEMORY]
    assert memory.shape == (4, SIZE) and np.all(np.any(np.asarray(memory) != 0.0, axis=1) | _fresh(half))
    assert not any(
        MEMORY in part for part in (half.environments.statistics.mean, half.environments.statistics.variance)
    )
    checkpoint.save(tmp_path, half, keep=1)
    resumed = checkpoint.restore(tmp_path, jax.eval_shape(agent(name).init, jax.random.key(0)))
    assert_same_bits(after(agent(name), resumed, 2), after(agent(name), half, 2))


def _fresh(state):
    """Environments at the first step of an episode."""
    return np.asarray(state.environments.state.step_count) == 0


def losses(config, x64_params, key=3):
    """SHAC's loss of one environment as a function of the actor's parameters."""
    env = remembering(memory_toys.ShownOnce(gain=jnp.float64(0.5), length=6), SIZE)
    networks = make_actor_critic(env, config)
    state = jax.jit(functools.partial(shac.init, config))(EnvLeaves.of(env), jax.random.key(0))
    first = jax.tree.map(lambda a: a[0], state.environments.state)

    def loss(params):
        return shac.actor_loss(
            params, state.common(), AutoReset(env=env), first, jax.random.key(key), networks=networks
        )[0]

    return loss, state.actor_params if x64_params is None else x64_params


@pytest.mark.parametrize("differentiate", ["full", "checkpointed"])
def test_the_gradient_through_time_is_the_finite_difference(x64, differentiate):
    config = memory_toys.config("shac", horizon=9, differentiate=differentiate, stagger_episodes=False)
    loss, params = losses(config, None)
    both = jax.jit(jax.value_and_grad(loss))
    _, grad = both(params)
    generator = np.random.default_rng(0)
    way = jax.tree.map(lambda p: generator.normal(size=p.shape), params)

    def shifted(step):
        return both(jax.tree.map(lambda p, w: p + step * w, params, way))[0]

    slope = sum(np.vdot(g, w) for g, w in zip(jax.tree.leaves(grad), jax.tree.leaves(way), strict=True))
    np.testing.assert_allclose(slope, (shifted(1e-5) - shifted(-1e-5)) / 2e-5, rtol=1e-6)


def test_without_the_way_through_time_the_gradient_is_another_one(x64):
    changes = {"horizon": 5, "stagger_episodes": False}
    loss, params = losses(memory_toys.config("shac", **changes), None)
    cut, _ = losses(memory_toys.config("shac", **changes, truncate_every=1), params)
    (value, grad), (same, grad_within) = (jax.jit(jax.value_and_grad(one))(params) for one in (loss, cut))
    through, within = (g["params"]["memory"]["recurrent"]["kernel"] for g in (grad, grad_within))
    assert np.linalg.norm(through - within) > 0.1 * np.linalg.norm(through) > 0.0
    np.testing.assert_array_equal(value, same)


def test_ppo_recomputes_the_log_probabilities_of_the_rollout():
    config = memory_toys.config("ppo", horizon=9)
    env = memory_toys.shown_once()
    known = memory_toys.agent("ppo", env, horizon=9)
    state = after(known, known.init(jax.random.key(1)), 1)
    networks = make_actor_critic(state.environments.env.first(), config)
    act = functools.partial(ppo.act, networks=networks)
    _, t = state.environments.map(act, state.common(), state.environments.split(jax.random.key(2)))
    assert t.done[:, :-1].any(axis=1).all() and t.obs[MEMORY][:, 0].any()  # episodes end amid it; memory at first
    batch, _ = ppo.make_batch(networks, state, t)
    again = jax.vmap(functools.partial(networks.distributions, state.actor_params))(batch.obs, batch.begins)
    np.testing.assert_allclose(again.mean, batch.mean, rtol=1e-4, atol=1e-5)
    log_prob = jax.vmap(jax.vmap(lambda distribution, raw: distribution.log_prob_raw(raw)))(again, batch.raw)
    np.testing.assert_allclose(log_prob, batch.log_prob, rtol=1e-4, atol=1e-4)
    for part in (batch, jax.tree.map(lambda a: a[:2], batch)):
        _, metrics = ppo.ppo_loss((state.actor_params, state.critic_params), networks=networks, batch=part)
        np.testing.assert_allclose(metrics["kl"], 0.0, atol=1e-6)


def test_minibatches_of_a_policy_with_memory_are_whole_sequences():
    steps = jnp.arange(12).reshape(4, 3)
    parts = ppo.shuffled(jax.random.key(0), {"step": steps}, 2, sequences=True)["step"]
    assert parts.shape == (2, 2, 3)
    np.testing.assert_array_equal(np.sort(parts.reshape(4, 3), axis=0), steps)
    with pytest.raises(
        ValueError, match="minibatches is 3, which does not divide num_envs = 4: choose a divisor, because"
    ):
        memory_toys.config("ppo", minibatches=3, horizon=6)


@pytest.mark.parametrize("name", ["sac", "flash_sac", "trajopt", "sapo_ivw", "sapo_agpo", "sapo_from_demonstrations"])
def test_an_algorithm_that_cannot_train_a_memory_says_so(name):
    with pytest.raises(ValueError, match=r"memory is 8: give 0, because .*; sapo, shac, apg, ahac, rpo and ppo train"):
        algorithm(name).config_type(memory=8)
    assert algorithm(name).config_type().memory == 0


def test_without_memory_neither_environment_nor_networks_nor_policy_know_of_it():
    plain = make_sapo(ENV, memory_toys.config("sapo", memory=0))
    state = jax.eval_shape(plain.init, jax.random.key(0))
    assert state.environments.env.form == EnvLeaves.of(ENV).form
    assert MEMORY not in state.environments.state.obs and MEMORY not in state.actor_params["params"]
    assert stage(ENV, plain.policy) is ENV and not hasattr(plain.policy, "initial_memory")


def test_each_environment_of_a_batch_may_have_its_own_parameters_and_draw_them():
    from rewax.envs import stack

    envs = stack([memory_toys.ShownOnce(gain=jnp.float32(gain)) for gain in (0.1, 0.2, 0.3, 0.4)])
    known = algorithm("ppo").make(
        envs, memory_toys.config("ppo"), randomize=lambda key, env: env.replace(gain=env.gain + jax.random.uniform(key))
    )
    state = jax.eval_shape(known.train_step, jax.eval_shape(known.init, jax.random.key(0)))[0]
    assert state.environments.state.obs[MEMORY].shape == (4, SIZE)
    assert state.environments.state.drawn[".gain"].shape == (4,)


def test_a_batch_of_tasks_whose_reset_draws_arrays_may_have_a_memory():
    """The observations of a task are those of its reset, which needs one environment, not a batch."""
    task = rewax.make("RollingFlat", scale="small")
    leaves = partition(rewax.envs.stack([task] * 2), 2, memory=SIZE)
    assert leaves.first().observation_spec[MEMORY].shape == (SIZE,)


def test_the_policy_needs_its_memory_and_evaluation_hands_it_on():
    known = agent("ppo")
    state, key = known.init(jax.random.key(0)), jax.random.key(7)
    first = ENV.reset(key)
    with pytest.raises(
        ValueError, match=r"the observation has no 'memory', but the policy has one: add policy\.initial"
    ):
        known.policy(state, first.obs, key)
    evaluate = make_evaluate(ENV, known.policy, 2)
    returns = evaluate(state, key, deterministic=True)["returns"]
    for i, episode in enumerate(jax.random.split(key, 2)):
        current, memory, total = ENV.reset(jax.random.split(episode)[0]), known.policy.initial_memory(), 0.0
        for _ in range(ENV.episode_length):
            action, memory = known.policy(state, {**current.obs, MEMORY: memory}, key, deterministic=True)
            current = ENV.step(current, action)
            total += current.reward
        np.testing.assert_allclose(returns[i], total, rtol=1e-5)
    mixed = make_evaluate(ENV, any_of(ENV, known.policy), 2)
    np.testing.assert_allclose(mixed((state, MODES.index("deterministic")), key)["returns"], returns, rtol=1e-5)
    still = mixed((state, MODES.index("no action")), key)["returns"]
    goals = jnp.stack([ENV.reset(jax.random.split(k)[0]).physics["goal"][0] for k in jax.random.split(key, 2)])
    np.testing.assert_allclose(still, -ENV.episode_length * goals**2, rtol=1e-5)


def test_the_critics_see_the_memory_unless_they_are_told_what_to_see():
    env = remembering(ENV, SIZE)
    obs = env.reset(jax.random.key(0)).obs
    other = {**obs, MEMORY: obs[MEMORY] + 1.0}
    for names, same in (((), False), (("x", "goal"), True)):
        networks = make_actor_critic(env, memory_toys.config("sapo", critic_observe=names))
        params = networks.critics.init(jax.random.key(1), obs)
        values = [networks.critics.apply(params, each) for each in (obs, other)]
        assert np.array_equal(*values) == same


def test_a_policy_without_memory_is_recognised():
    assert action_of(jnp.ones(1)) == 1.0 and stage(toys.point_mass(), lambda *_: 0).episode_length == 5


def test_a_policy_cannot_choose_to_observe_its_memory():
    with pytest.raises(ValueError, match="observe has 'memory', the policy's own memory, which it always sees"):
        memory_toys.agent("shac", observe=("x", MEMORY))
    memory_toys.agent("shac", observe=("x",), critic_observe=("x", MEMORY))
