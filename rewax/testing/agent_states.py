"""``init`` and ``train_step`` of an agent: pure functions of a key and of a state, alike under every transformation."""

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.agents.base import Agent, Metrics, TrainState
from rewax.agents.run_state import Environments
from rewax.status import Status
from rewax.testing.functions import check_same
from rewax.testing.traced import UNTRACEABLE
from rewax.types import Key, PyTree

_PURE = "no Python state, no numpy random numbers, no callbacks that count"
_NEEDED = (
    "return", "reward", "episodes", "failed_episodes", "failed_env", "failed_leaf",
    *(f"status/{bit.name}" for bit in Status if bit is not Status.OK),
)  # fmt: skip
"""Metrics that the training loop reads."""
_COUNTERS = ("iteration", "env_steps")


class Iteration(NamedTuple):
    """A state and metrics, as ``train_step`` returned them."""

    state: TrainState
    metrics: Metrics


def check_parts(agent: Any) -> None:
    """The agent has its three functions."""
    for name in ("init", "train_step", "policy"):
        assert callable(getattr(agent, name, None)), (
            f"agent has no function {name}: give a rewax.agents.base.Agent(init=..., train_step=..., policy=...)"
        )


def compiled(what: str, function: Callable[..., Any], *args: Any) -> Any:
    """``function(*args)``; raises AssertionError, with what helps, where it cannot be traced."""
    try:
        return function(*args)
    except UNTRACEABLE as error:
        first = str(error).splitlines()[0].rstrip(".")
        raise AssertionError(
            f"{what} cannot be compiled ({first}): use jnp.where or lax.cond instead of if, jnp instead of numpy, "
            ".at[].set instead of assignment"
        ) from error


def check_init(agent: Agent, key: Key) -> TrainState:
    """One key gives one state, another key another one; the counters begin with 0."""
    compiled("init", jax.eval_shape, agent.init, key)
    state = agent.init(key)
    for path, leaf in jax.tree.leaves_with_path(state):
        assert isinstance(leaf, jax.Array), (
            f"{jax.tree_util.keystr(path)} of the state has type {type(leaf).__name__}: let init return arrays only"
        )
    for name in _COUNTERS:
        count = getattr(state, name, None)
        assert count is not None, f"the state has no field {name}: add it, jnp.int32(0) at first"
        is_int32 = count.shape == () and count.dtype == jnp.int32
        assert is_int32, f"{name} of the state is {_form(count)}: let it be int32()"
        assert int(count) == 0, f"{name} is {int(count)} after init: begin with 0"
    check_same(agent.init(key), state, 0.0, "two calls of init with one key", f"let init depend on its key: {_PURE}")
    other = agent.init(jax.random.fold_in(key, 1))
    pairs = zip(jax.tree.leaves(state), jax.tree.leaves(other), strict=True)
    assert any(not np.array_equal(_numbers(a), _numbers(b)) for a, b in pairs), (
        "init gives the same state for different keys: draw parameters and environments from the key"
    )
    return state


def check_train_step(agent: Agent, state: TrainState, key: Key, may_be_nan: Collection[str]) -> Iteration:
    """``train_step`` keeps the form of the state, counts, and reports finite scalars. Returns the first iteration."""
    form = jax.eval_shape(agent.init, key)
    out = compiled("train_step", jax.eval_shape, agent.train_step, form)
    assert isinstance(out, tuple) and len(out) == 2, "train_step returns no pair: return (state, metrics)"
    _check_form(form, out[0])
    first = Iteration(*agent.train_step(state))
    deleted = any(leaf.is_deleted() for leaf in jax.tree.leaves(state))
    assert agent.consumes or not deleted, (
        "train_step consumes its input: give the Agent consumes=True, or donate nothing"
    )
    kept = jax.tree.map(jnp.copy, first)  # the next call may consume the state
    second = Iteration(*agent.train_step(first.state))
    others = sorted(set(second.metrics) ^ set(kept.metrics))
    assert not others, f"metrics of the first and the second iteration differ in {others}: give the same names always"
    for count, now in ((1, kept), (2, second)):
        assert int(now.state.iteration) == count, (
            f"iteration is {int(now.state.iteration)} after train_step number {count}: add 1 in each"
        )
        _check_metrics(now.metrics, may_be_nan)
    assert 0 < int(kept.state.env_steps) < int(second.state.env_steps), (
        f"env_steps is {int(kept.state.env_steps)}, then {int(second.state.env_steps)} after two calls of train_step: "
        "add the control steps of all environments in each"
    )
    return kept


def check_repeats(agent: Agent, key: Key, expected: Iteration) -> None:
    """The same state gives the same bytes."""
    again = Iteration(*agent.train_step(agent.init(key)))
    _check_same_iteration(again, expected, 0.0, "two iterations from one state", f"let it depend on its state: {_PURE}")


def check_compiled_anew(agent: Agent, key: Key, expected: Iteration, tolerance: float) -> None:
    """A program traced once more does the same: ``train_step`` reads no Python state while it is traced."""
    original = getattr(agent.train_step, "__wrapped__", agent.train_step)
    anew = Iteration(*compiled("train_step", jax.jit(lambda state: original(state)), agent.init(key)))
    remedy = f"let train_step depend on its state: {_PURE}"
    _check_same_iteration(anew, expected, tolerance, "train_step and the same traced once more", remedy)


def check_seeds(agent: Agent, key: Key, tolerance: float) -> None:
    """Two seeds side by side are as each is alone."""
    keys = jax.random.split(key, 2)
    states = compiled("vmap(init)", jax.jit(jax.vmap(agent.init)), keys)
    together = compiled("vmap(train_step)", jax.jit(jax.vmap(agent.train_step)), states)
    for i in range(2):
        alone = Iteration(*agent.train_step(agent.init(keys[i])))
        row = Iteration(*jax.tree.map(lambda leaf, i=i: leaf[i], together))
        what = "vmap over seeds, and a run alone,"
        remedy = (
            "let a run depend on its own state only; rounding does it, too, where chaotic episodes amplify it: check "
            "with a shorter horizon, or another seed"
        )
        _check_same_iteration(row, alone, tolerance, what, remedy)


def check_failure(agent: Agent, key: Key) -> None:
    """If the physics of one environment becomes NaN, the finite parts of the state stay finite."""
    state = agent.init(key)
    environments = getattr(state, "environments", None)
    if not isinstance(environments, Environments) or environments.num_envs < 2:
        return
    failing = environments.state.replace(physics=jax.tree.map(_first_is_nan, environments.state.physics))
    # Its own arrays may hold NaN: those of the failed environment, and returns that are not known.
    finite = _finite_leaves(state.replace(environments=environments.common()))
    state, metrics = agent.train_step(state.replace(environments=environments.replace(state=failing)))
    for name in ("failed_episodes", "status/NAN"):
        assert name not in metrics or int(metrics[name]) >= 1, (
            f"metric {name!r} is {int(metrics[name])} though the physics of an environment became NaN: count it "
            "(rewax.agents.run_state), or max_failed_share never stops the run"
        )
    after = _finite_leaves(state.replace(environments=state.environments.common()))
    spoilt = [name for name in finite if finite[name] and not after[name]]
    assert not spoilt, (
        f"one environment failed, and {', '.join(spoilt[:3])} of the state is not finite after train_step: leave out "
        "gradients that are not finite (rewax.agents.gradients.mean_gradient) and steps with valid False"
    )


def _check_form(before: PyTree, after: PyTree) -> None:
    """Structure, shapes, dtypes: those of ``init`` and of ``train_step``."""
    assert jax.tree.structure(before) == jax.tree.structure(after), (
        "the state of train_step has another structure than that of init: return the same fields, None where it was"
    )
    for (path, a), b in zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True):
        what = f"{jax.tree_util.keystr(path)} of the state is {_form(a)} after init, {_form(b)} after train_step"
        assert _form(a) == _form(b), f"{what}: a scan needs them the same"


def _check_metrics(metrics: Metrics, may_be_nan: Collection[str]) -> None:
    missing = [name for name in _NEEDED if name not in metrics]
    assert not missing, (
        f"metrics lack {', '.join(map(repr, missing))}, which the training loop reads: add those of RunState.after, or "
        "of rewax.agents.episodes.episode_metrics"
    )
    for name, value in metrics.items():
        assert jnp.shape(value) == (), f"metric {name!r} has shape {jnp.shape(value)}: it must be a scalar"
        nan = bool(jnp.isnan(value))
        assert bool(jnp.isfinite(value)) or (nan and name in may_be_nan), (
            f"metric {name!r} is {float(value)}: look for a mean over nothing or a division by 0, or name it in "
            "may_be_nan if an iteration may lack it"
        )


def _check_same_iteration(a: Iteration, b: Iteration, tolerance: float, what: str, remedy: str) -> None:
    check_same(a.state, b.state, tolerance, what, remedy)
    check_same(a.metrics, b.metrics, tolerance, what, remedy, of="the metrics")


def _form(leaf: Any) -> str:
    weak = " (weakly typed)" if getattr(leaf, "weak_type", False) else ""
    return f"{leaf.dtype}{leaf.shape}{weak}"


def _numbers(leaf: jax.Array) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def _first_is_nan(leaf: jax.Array) -> jax.Array:
    return leaf.at[0].set(jnp.nan) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def _finite_leaves(tree: PyTree) -> dict[str, bool]:
    """Whether the floating leaves are finite, by name."""
    pairs = jax.tree.leaves_with_path(tree)
    floating = [(path, leaf) for path, leaf in pairs if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return {jax.tree_util.keystr(path): bool(jnp.all(jnp.isfinite(leaf))) for path, leaf in floating}
