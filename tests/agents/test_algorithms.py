"""Every algorithm learns, repeats itself bit for bit, resumes, reports its metrics, and is found by its name."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys
from agent_cases import CASES, ENV, agent, assert_same_bits, raw, trained

from rewax.agents.registry import algorithm, list_algorithms, make_agent
from rewax.envs.base import ArraySpec
from rewax.status import Status
from rewax.training.evaluation.episodes import make_evaluate
from rewax.training.storage import checkpoint

ALL = sorted(CASES)


@pytest.mark.parametrize("name", ALL)
def test_it_learns_and_compiles_once(name):
    """The point starts 0.5 to 1.5 from its goal. Without training it stays there and earns -5; the optimum is -0.4."""
    state, rows = trained(name)
    key = jax.random.key(5)
    result = make_evaluate(ENV, agent(name).policy, 64)(state, key, deterministic=True)
    floor = -0.75 if name in ("trajopt", "sac", "flash_sac") else -0.6  # one sequence for all starts cannot do better
    assert result["mean"] > floor, result["mean"]
    assert agent(name).train_step._cache_size() <= 1  # 0: another module has cleared the caches since
    assert sum(int(row["failed_episodes"]) for row in rows) == 0


@pytest.mark.parametrize("name", ALL)
def test_two_runs_are_identical_and_a_resumed_one_too(name, tmp_path):
    start = agent(name).init(jax.random.key(1))
    assert_same_bits(start, agent(name).init(jax.random.key(1)))
    state = start
    for _ in range(3):
        state, _ = agent(name).train_step(state)
    checkpoint.save(tmp_path, state, keep=1)
    resumed = checkpoint.restore(tmp_path, jax.eval_shape(agent(name).init, jax.random.key(0)))
    ends = []
    for _ in range(3):
        resumed, metrics = agent(name).train_step(resumed)
    ends.append((resumed, metrics))
    state = agent(name).init(jax.random.key(1))
    for _ in range(6):
        state, metrics = agent(name).train_step(state)
    assert_same_bits((state, metrics), ends[0])


@pytest.mark.parametrize("name", ALL)
def test_it_reports_what_the_loop_needs(name):
    state, rows = trained(name)
    needed = {"return", "reward", "episodes", "failed_episodes", "failed_env", "failed_leaf"}
    needed |= {f"status/{bit.name}" for bit in Status if bit}
    assert needed <= set(rows[0])
    assert all(set(row) == set(rows[0]) for row in rows)
    assert int(state.iteration) == CASES[name].num_iterations
    config = CASES[name].config
    if name not in ("ahac", "sapo_from_demonstrations"):  # their iterations vary in length
        per_iteration = config.num_envs * config.steps_in(ENV)
        assert int(state.env_steps) == per_iteration * CASES[name].num_iterations


@pytest.mark.parametrize("name", ALL)
def test_an_environment_that_begins_with_nan_does_not_stop_the_others(name):
    """Such a reset is a failed episode, and its numbers reach neither gradients nor the replay buffer."""
    state = agent(name).init(jax.random.key(3))
    for _ in range(9 if "sac" in name else 4):  # SAC fills its replay buffer before it learns
        state, _ = agent(name).train_step(state)

    def broken(leaf):
        return leaf.at[1].set(jnp.nan) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    environments = state.environments.replace(state=jax.tree.map(broken, state.environments.state))
    starts = (state, jax.tree.map(jnp.copy, state.replace(environments=environments)))  # a step may consume its own
    old, ends = jax.tree.map(jnp.copy, state), [agent(name).train_step(start) for start in starts]
    restarts = name in ("trajopt", "apg_full", "sapo_from_demonstrations")  # an iteration begins with new episodes
    assert [int(metrics["failed_episodes"]) for _, metrics in ends] == [0, 0 if restarts else 1]
    unknown = [{key for key, value in metrics.items() if not np.isfinite(value)} - {"return"} for _, metrics in ends]
    assert unknown[0] == unknown[1]
    for part in ("actor_params", "critic_params", "actions"):
        if hasattr(old, part):
            healthy, other = (_moved(getattr(end, part), getattr(old, part)) for end, _ in ends)
            assert 0.3 < other / healthy < 3.0, part


def _moved(new, old) -> float:
    return float(optax.tree.norm(jax.tree.map(jnp.subtract, new, old)))


FEW = ("sapo",)


@pytest.mark.parametrize("name", [name if name in FEW else pytest.param(name, marks=pytest.mark.slow) for name in ALL])
def test_many_seeds_at_once_are_their_solo_runs(name):
    keys = jax.random.split(jax.random.key(7), 2)
    together = jax.jit(jax.vmap(agent(name).init))(keys)
    step = jax.jit(jax.vmap(agent(name).train_step))
    for _ in range(2):
        together, _ = step(together)
    for i in range(2):
        alone = agent(name).init(keys[i])
        for _ in range(2):
            alone, _ = agent(name).train_step(alone)
        jax.tree.map(
            lambda a, b, i=i: np.testing.assert_allclose(raw(a)[i], raw(b), rtol=2e-3, atol=2e-4), together, alone
        )


def test_the_names_are_those_of_the_paper_and_its_ablations():
    assert {"sapo", "shac", "apg", "ppo", "sac", "trajopt", "ahac", "rpo", "shac2"} <= set(list_algorithms())
    for name in list_algorithms():
        known = algorithm(name)
        for scale in ("small", "paper"):
            config = known.preset("RollingFlat", scale)
            assert type(config) is known.config_type and hash(config)
    shac2, sapo = algorithm("shac2").preset("RollingFlat", "paper"), algorithm("sapo").preset("RollingFlat", "paper")
    assert not (shac2.entropy_in_return or shac2.entropy_in_targets or shac2.entropy_in_loss)
    options = ("entropy_in_return", "entropy_in_targets", "entropy_in_loss", "learn_temperature")
    assert dataclasses.replace(shac2, **dict.fromkeys(options, True)) == sapo


def test_policies_answer_one_environment():
    for name in ALL:
        state = agent(name).init(jax.random.key(0))
        action = agent(name).policy(state, {"x": jnp.array([1.0])}, jax.random.key(0), deterministic=True)
        assert action.shape == (1,) and np.all(np.abs(action) <= 1.0)


@pytest.mark.parametrize("name", ["sapo_agpo", "sapo_from_demonstrations", "sapo_ivw"])
def test_a_state_keeps_its_types_in_double_precision(name, x64):
    case = CASES[name]
    made = make_agent(case.name, toys.point_mass(), case.config)
    state = jax.eval_shape(made.init, jax.random.key(0))
    after, metrics = jax.eval_shape(made.train_step, state)
    assert jax.tree.map(lambda leaf: leaf.dtype, after) == jax.tree.map(lambda leaf: leaf.dtype, state)
    assert metrics["reward"].dtype == jnp.float64


def test_actions_beyond_one_are_refused(monkeypatch):
    for shape, size in (((), 1), ((2, 3), 6), ((0,), 1)):
        monkeypatch.setattr(toys.PointMass, "action_spec", ArraySpec(shape, -1.0, 1.0))
        for name in ("sapo", "sac"):
            with pytest.raises(ValueError, match=rf"policies return vectors: give it the shape \({size},\), and"):
                make_agent(name, toys.point_mass())
    monkeypatch.setattr(toys.PointMass, "action_spec", ArraySpec((1,), -4.0, 4.0))
    for name in ("sapo", "apg", "sac"):
        with pytest.raises(ValueError, match=r"action_spec has the bounds -4.0 and 4.0, but policies act in \[-1, 1\]"):
            make_agent(name, toys.point_mass(), CASES[name].config)
