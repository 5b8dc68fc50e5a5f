"""Checks that users can run on their own environments."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import ArraySpec, Env, State
from rewax.status import Status
from rewax.types import Array, Key, PyTree
from rewax.viz import shapes

_JIT_TOLERANCE = 1e-4  # relative; a compiled program may fuse and reorder single-precision sums


def check_env(env: Env, *, seed: int = 0, tolerance: float = _JIT_TOLERANCE, check_full_episode: bool = True) -> None:
    """Check an environment against the protocol of ``rewax.envs.base.Env``.

    Observations match their spec; states keep their structure, so that ``lax.scan`` can carry them; ``reset`` depends
    on its key; ``jit`` and ``vmap`` change nothing beyond rounding; ``step`` clips actions, never resets, truncates
    exactly at ``episode_length`` and never together with terminating; the reward has a finite, not identically zero
    gradient with respect to the actions; what ``particles`` and ``render_shapes`` give can be drawn.

    Args:
      env: unbatched environment, without ``AutoReset``.
      seed: of initial states and actions.
      tolerance: relative difference that rounding may make within one step.
      check_full_episode: also run to ``episode_length``; the one check that may take long.

    Raises:
      AssertionError: a sentence that names what is wrong.

    Example:
      >>> check_env(rewax.make("RollingFlat", scale="small"))
    """
    key = jax.random.key(seed)
    _check_specs(env)
    state = jax.jit(env.reset)(key)
    _check_first_state(env, state)
    _check_reset_key(env, state, key)
    action = _random_action(env, jax.random.fold_in(key, 1))
    step = jax.jit(env.step)
    new = step(state, action)
    _check_next_state(env, state, new)
    for source, each in (("reset", state), ("step", new)):
        _check_pictures(env, each, source)
    _check_same(new, env.step(state, action), tolerance, "jit(step) and step")
    _check_vmap(env, step, key, tolerance)
    _check_action_bounds(env, step, state, tolerance)
    _check_gradient(env, state, key)
    if check_full_episode:
        _check_episode(env, step, state, key)


def _check_specs(env: Env) -> None:
    specs, action, length = env.observation_spec, env.action_spec, env.episode_length
    assert isinstance(specs, dict) and specs, f"observation_spec is {specs!r}: use a non-empty dict of ArraySpec"
    for name, spec in [*specs.items(), ("action_spec", action)]:
        assert isinstance(spec, ArraySpec), f"the spec of {name} is {spec!r}: use rewax.envs.base.ArraySpec"
        assert spec.low < spec.high, f"the spec of {name} has bounds [{spec.low}, {spec.high}]: low must be below high"
    finite = math.isfinite(action.low) and math.isfinite(action.high)
    assert finite, f"action_spec is unbounded ({action.low}, {action.high}): give finite bounds, by convention -1 and 1"
    assert isinstance(length, int) and length >= 1, f"episode_length is {length!r}: use a positive int"


def _check_first_state(env: Env, state: Any) -> None:
    assert isinstance(state, State), f"reset returned a {type(state).__name__}: return a rewax.envs.base.State"
    _check_values(env, state, "reset")
    assert not bool(state.done), "reset returned a state that has terminated or been truncated: begin with both false"
    assert int(state.step_count) == 0, f"reset returned step_count {int(state.step_count)}: begin with 0"
    assert float(state.reward) == 0.0, f"reset returned reward {float(state.reward)}: begin with 0"


def _check_values(env: Env, state: State, source: str) -> None:
    """Shapes, dtypes, bounds and finiteness of what a user sees."""
    missing = set(env.observation_spec) ^ set(state.obs)
    assert not missing, f"obs of {source} and observation_spec differ in {sorted(missing)}: give both the same names"
    for name, spec in env.observation_spec.items():
        value = state.obs[name]
        assert value.shape == spec.shape, f"obs {name!r} of {source} has shape {value.shape}, its spec {spec.shape}"
        assert jnp.issubdtype(value.dtype, jnp.floating), (
            f"obs {name!r} of {source} has dtype {value.dtype}: use a float"
        )
        assert _finite(value), f"obs {name!r} of {source} holds a number that is not finite"
        inside = bool(jnp.all((value >= spec.low) & (value <= spec.high)))
        assert inside, f"obs {name!r} of {source} leaves the bounds of its spec, [{spec.low}, {spec.high}]"
    for name in ("reward", "terminated", "truncated", "step_count", "status"):
        shape = jnp.shape(getattr(state, name))
        assert shape == (), f"{name} of {source} has shape {shape}: it must be a scalar"
    for name in ("terminated", "truncated"):
        dtype = getattr(state, name).dtype
        assert dtype == jnp.bool_, f"{name} of {source} has dtype {dtype}: use bool"
    for name, value in state.metrics.items():
        assert jnp.shape(value) == (), f"metric {name!r} of {source} has shape {jnp.shape(value)}: it must be a scalar"
    assert _finite(state.reward), f"the reward of {source} is not finite"


def _check_next_state(env: Env, old: State, new: State) -> None:
    """One step keeps the structure and counts."""
    changed = set(old.metrics) ^ set(new.metrics)
    assert not changed, f"metrics of reset and step differ in {sorted(changed)}: give both the same keys"
    before, after = jax.tree.structure(old), jax.tree.structure(new)
    assert before == after, f"reset and step return states of different structure: {before} and {after}"
    for (path, a), b in zip(jax.tree.leaves_with_path(old), jax.tree.leaves(new), strict=True):
        same = a.shape == b.shape and a.dtype == b.dtype
        kinds = f"{a.dtype}{a.shape} after reset, {b.dtype}{b.shape} after step"
        assert same, f"{jax.tree_util.keystr(path)} of the state is {kinds}: a scan needs them the same"
    _check_values(env, new, "step")
    assert int(new.step_count) == 1, f"step_count is {int(new.step_count)} after one step: it counts steps since reset"


def _check_pictures(env: Any, state: State, source: str) -> None:
    """What the environment offers to pictures after a reset or a step can be drawn."""
    particles, render_shapes = getattr(env, "particles", None), getattr(env, "render_shapes", None)
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
    except Exception as error:  # whatever the environment's own method raises
        kind = type(error).__name__
        raise AssertionError(f"{name} raises {kind} after {source}: {error}; see the traceback above") from error
    alone = render_shapes is not None and particles is None
    followed = not alone or any(drawing["kind"] != "plane" for drawing in drawings)
    assert followed, f"render_shapes after {source} gives nothing but planes: give at least one shape that moves"


def _check_reset_key(env: Env, state: State, key: Key) -> None:
    reset = jax.jit(env.reset)
    _check_same(reset(key), state, 0.0, "two resets with one key")
    other = reset(jax.random.fold_in(key, 2))
    differs = any(not np.array_equal(a, b) for a, b in zip(_floats(state), _floats(other), strict=True))
    assert differs, "reset gives the same state for different keys: draw the initial state from the key"
    differs = not np.array_equal(jax.random.key_data(state.key), jax.random.key_data(other.key))
    assert differs, "reset leaves the same key in the state for different keys: derive state.key from the argument"


def _check_vmap(env: Env, step: Any, key: Key, tolerance: float) -> None:
    keys, actions = jax.random.split(key, 3), jax.vmap(lambda k: _random_action(env, k))(jax.random.split(key, 3))
    batch = jax.jit(jax.vmap(lambda k, action: env.step(env.reset(k), action)))(keys, actions)
    reset = jax.jit(env.reset)
    for i in range(3):
        row = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
        _check_same(row, step(reset(keys[i]), actions[i]), tolerance, "vmap of reset and step, and a loop over them,")


def _check_action_bounds(env: Env, step: Any, state: State, tolerance: float) -> None:
    spec = env.action_spec
    for bound, direction in ((spec.low, -1.0), (spec.high, 1.0)):
        beyond = step(state, jnp.full(spec.shape, bound + direction * 10.0 * (spec.high - spec.low)))
        _check_values(env, beyond, "step with an action beyond its bounds")
        what = f"steps with an action beyond its bound {bound} and at it"
        _check_same(beyond, step(state, jnp.full(spec.shape, bound)), tolerance, what, "clip the action in step")


def _check_gradient(env: Env, state: State, key: Key, num_steps: int = 3) -> None:
    """Reward after a few steps with respect to their actions; an action may act late, so zeros in some are fine."""
    actions = 0.9 * jax.vmap(lambda k: _random_action(env, k))(jax.random.split(key, num_steps))

    def total(actions: Array) -> tuple[Array, Array]:
        def body(state: State, action: Array) -> tuple[State, Array]:
            state = env.step(state, action)
            return state, state.reward

        last, rewards = jax.lax.scan(body, state, actions)
        return jnp.sum(rewards), last.status

    gradient, status = jax.jit(jax.grad(total, has_aux=True))(actions)
    failed = Status(int(status))
    assert failed == Status.OK, (
        f"{num_steps} steps of random actions fail numerically ({failed!r}): shorter substeps or softer contacts help"
    )
    assert _finite(gradient), "the gradient of the reward with respect to the actions holds a number that is not finite"
    moved = bool(jnp.any(gradient != 0))
    assert moved, f"the reward of {num_steps} steps has a zero gradient with respect to their actions"


def _check_episode(env: Env, step: Any, state: State, key: Key) -> None:
    """Run to the end of the episode, and one step beyond."""
    length = env.episode_length
    for count in range(1, length + 1):
        state = step(state, _random_action(env, jax.random.fold_in(key, count)))
        both = bool(state.terminated & state.truncated)
        assert not both, f"step {count} is both terminated and truncated: terminated wins, truncated is then false"
        reached = int(state.step_count)
        assert reached == count, (
            f"step_count is {reached} after {count} steps: step must not reset, AutoReset does that"
        )
        early = bool(state.truncated) and count < length
        assert not early, f"the episode is truncated at step {count}, before episode_length {length}"
        if bool(state.terminated):
            return
    assert bool(state.truncated), f"the episode is not truncated at episode_length {length}"
    beyond = int(step(state, _random_action(env, key)).step_count)
    assert beyond == length + 1, "step resets after the end of an episode: leave that to AutoReset"


def _random_action(env: Env, key: Key) -> Array:
    spec = env.action_spec
    return jax.random.uniform(key, spec.shape, minval=spec.low, maxval=spec.high)


def _floats(tree: PyTree) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]


def _finite(value: Array) -> bool:
    return bool(jnp.all(jnp.isfinite(value)))


def _check_same(a: PyTree, b: PyTree, tolerance: float, what: str, remedy: str = "they must be the same") -> None:
    """Leaves agree within ``tolerance`` relative to the largest number of the leaf; integers and keys exactly."""
    assert jax.tree.structure(a) == jax.tree.structure(b), f"{what} return different structures: {remedy}"
    for (path, x), y in zip(jax.tree.leaves_with_path(a), jax.tree.leaves(b), strict=True):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        x, y = np.asarray(x), np.asarray(y)
        slack = tolerance * max(1.0, np.max(np.abs(y), initial=0.0)) if jnp.issubdtype(x.dtype, jnp.floating) else 0
        same = np.allclose(x, y, rtol=0.0, atol=slack, equal_nan=True)
        assert same, f"{what} differ in {jax.tree_util.keystr(path)} of the state: {remedy}"
