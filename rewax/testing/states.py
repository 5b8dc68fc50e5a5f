"""Checks of specs, of the pytree of an environment, and of its states."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from rewax.envs.base import ArraySpec, Env, State
from rewax.envs.wrappers import AutoReset, is_number, is_or_contains
from rewax.status import describe, remedy
from rewax.types import Array
from rewax.viz import shapes


def check_specs(env: Env) -> None:
    """Checks the specs of observations and actions, and the length of an episode."""
    assert not is_or_contains(env, AutoReset), "env has an AutoReset, and agents add one: give it without AutoReset"
    specs, action, length = env.observation_spec, env.action_spec, env.episode_length
    assert isinstance(specs, dict) and specs, f"observation_spec is {specs!r}: use a non-empty dict of ArraySpec"
    for name, spec in [*specs.items(), ("action_spec", action)]:
        assert isinstance(spec, ArraySpec), f"the spec of {name} is {spec!r}: use rewax.envs.base.ArraySpec"
        assert spec.low < spec.high, f"the spec of {name} has bounds [{spec.low}, {spec.high}]: low must be below high"
    finite = math.isfinite(action.low) and math.isfinite(action.high)
    assert finite, f"action_spec is unbounded ({action.low}, {action.high}): give finite bounds, by convention -1 and 1"
    assert isinstance(length, int) and length >= 1, f"episode_length is {length!r}: use a positive int"


def check_leaves(env: Env) -> None:
    """Checks that the environment is a pytree of arrays and numbers, as agents need it."""
    kind = type(env).__name__
    for path, leaf in jax.tree.leaves_with_path(env):
        name = jax.tree_util.keystr(path)
        known = is_number(leaf) or isinstance(leaf, jax.Array) or hasattr(leaf, "__array__")
        remedy = f"decorate {kind} with rewax.struct.dataclass" if leaf is env else "make its field a static_field()"
        what = f"{kind} is no pytree" if leaf is env else f"{name} of {kind} is a {type(leaf).__name__}"
        assert known, f"{what}: an environment's leaves are arrays and numbers; {remedy}"


def check_first_state(env: Env, state: Any) -> None:
    """Checks the state that ``reset`` returns."""
    assert isinstance(state, State), f"reset returned a {type(state).__name__}: return a rewax.envs.base.State"
    check_values(env, state, "reset")
    assert not bool(state.done), "reset returned a state that has terminated or been truncated: begin with both false"
    assert int(state.step_count) == 0, f"reset returned step_count {int(state.step_count)}: begin with 0"
    assert float(state.reward) == 0.0, f"reset returned reward {float(state.reward)}: begin with 0"
    _check_status(state, "reset")


def check_values(env: Env, state: State, source: str) -> None:
    """Checks shapes, dtypes, bounds and finiteness of observation, reward, flags and metrics."""
    missing = set(env.observation_spec) ^ set(state.obs)
    assert not missing, f"obs of {source} and observation_spec differ in {sorted(missing)}: give both the same names"
    for name, spec in env.observation_spec.items():
        value, what = state.obs[name], f"obs {name!r} of {source}"
        shapes_differ = f"{what} has shape {value.shape}, its spec {spec.shape}: give the spec what observe returns"
        assert value.shape == spec.shape, shapes_differ
        assert jnp.issubdtype(value.dtype, jnp.floating), f"{what} has dtype {value.dtype}: use a float"
        remedy = "look for a division by 0 or the root of a negative number"
        assert finite(value), f"{what} holds a number that is not finite: {remedy}"
        inside = bool(jnp.all((value >= spec.low) & (value <= spec.high)))
        assert inside, f"{what} leaves the bounds of its spec, [{spec.low}, {spec.high}]: widen them, or clip"
    for name in ("reward", "terminated", "truncated", "step_count", "status"):
        shape = jnp.shape(getattr(state, name))
        assert shape == (), f"{name} of {source} has shape {shape}: it must be a scalar"
    for name in ("terminated", "truncated"):
        dtype = getattr(state, name).dtype
        assert dtype == jnp.bool_, f"{name} of {source} has dtype {dtype}: use bool"
    for name, value in state.metrics.items():
        assert jnp.shape(value) == (), f"metric {name!r} of {source} has shape {jnp.shape(value)}: it must be a scalar"
        assert finite(value), f"metric {name!r} of {source} is not finite: look for a division by 0"
    dtype = jnp.result_type(state.reward)
    assert jnp.issubdtype(dtype, jnp.floating), f"the reward of {source} has dtype {dtype}: use a float"
    assert finite(state.reward), f"the reward of {source} is not finite: build the state with next_state, which ends it"


def check_next_state(env: Env, old: State, new: State) -> None:
    """Checks that a step keeps the structure of the state and counts steps."""
    changed = set(old.metrics) ^ set(new.metrics)
    assert not changed, f"metrics of reset and step differ in {sorted(changed)}: give both the same keys"
    before, after = jax.tree.structure(old), jax.tree.structure(new)
    assert before == after, (
        f"reset and step return states of different structure: {before} and {after}; a scan needs one"
    )
    for (path, a), b in zip(jax.tree.leaves_with_path(old), jax.tree.leaves(new), strict=True):
        same = a.shape == b.shape and a.dtype == b.dtype
        kinds = f"{a.dtype}{a.shape} after reset, {b.dtype}{b.shape} after step"
        assert same, f"{jax.tree_util.keystr(path)} of the state is {kinds}: a scan needs them the same"
        weak_before, weak_after = (getattr(leaf, "weak_type", False) for leaf in (a, b))
        assert not weak_before or weak_after, (
            f"{jax.tree_util.keystr(path)} of the state is a Python number after reset and an array after step, so "
            "that a second step compiles again: give jnp.zeros(()) or jnp.asarray(number, dtype) in reset"
        )
    check_values(env, new, "step")
    assert int(new.step_count) == 1, f"step_count is {int(new.step_count)} after one step: it counts steps since reset"
    _check_status(new, "the first step")


def check_pictures(env: Any, state: State, source: str) -> None:
    """Checks that ``particles`` and ``render_shapes`` of a state can be drawn."""
    bare = getattr(env, "unwrapped", env)
    particles, render_shapes = getattr(bare, "particles", None), getattr(bare, "render_shapes", None)
    name = "particles"
    try:
        if particles is not None:
            shapes.check_cloud(particles(state.physics))
        name = "render_shapes"
        drawings = [] if render_shapes is None else list(render_shapes(state.physics))
        for drawing in drawings:
            shapes.check_drawing(drawing)
    except ValueError as error:
        raise AssertionError(f"{name} after {source} cannot be drawn: {error}") from error
    except Exception as error:  # the method of a user may raise anything
        kind = type(error).__name__
        raise AssertionError(f"{name} raises {kind} after {source}: {error}; see the traceback above") from error
    alone = render_shapes is not None and particles is None
    followed = not alone or any(drawing["kind"] != "plane" for drawing in drawings)
    assert followed, f"render_shapes after {source} gives nothing but planes: give at least one shape that moves"


def finite(value: Array) -> bool:
    """Whether all numbers are finite."""
    return bool(jnp.all(jnp.isfinite(value)))


def _check_status(state: State, source: str) -> None:
    bits = int(state.status)
    help_ = "begin where the physics is sound" if source == "reset" else f"give {remedy(bits)}"
    assert bits == 0, f"{source} sets the status {describe(bits)}: {help_}; rewax.Status says what each bit means"
