"""Checks of ``reset`` and ``step``: purity, equal results under ``jit`` and ``vmap``, time limit."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.status import FATAL, describe, remedy
from rewax.testing.states import check_values, finite
from rewax.testing.traced import named, random_action
from rewax.types import Array, Key, PyTree

_Reset = Callable[[Key], State]
_Step = Callable[[State, Array], State]


def check_reset_key(reset: _Reset, state: State, key: Key, say: Callable[[str], None]) -> None:
    """Checks that equal keys give equal states, and different keys different keys in the state.

    A task may begin all episodes with the same numbers: ``say`` then gets a line.
    """
    pure = "let reset depend on its key alone"
    check_same(reset(key), state, 0.0, "two resets with one key", pure)
    other = reset(jax.random.fold_in(key, 2))
    differs = any(not np.array_equal(a, b) for a, b in zip(_floats(state), _floats(other), strict=True))
    if not differs:
        say("all episodes begin with the same numbers; if that is not meant, draw the initial state from the key")
    differs = not np.array_equal(jax.random.key_data(state.key), jax.random.key_data(other.key))
    assert differs, "reset leaves the same key in the state for different keys: derive state.key from the argument"


_DRAWS = 3
"""Further steps of which one has to draw other numbers: few choices may agree by chance."""


def check_step_key(step: _Step, state: State, action: Array, new: State) -> None:
    """Checks that states whose keys differ have different keys after a step, and that steps draw different numbers.

    An observation that depends on the key has to change from one step to the next, where nothing but key and step count
    does.
    """
    other = step(state.replace(key=jax.random.fold_in(state.key, 3)), action)
    differs = not np.array_equal(jax.random.key_data(new.key), jax.random.key_data(other.key))
    assert differs, (
        "step gives the same key for different keys, so that later episodes begin alike: keep state.key, or split it"
    )
    stale, later = [name for name in new.obs if not np.array_equal(new.obs[name], other.obs[name])], new
    for _ in range(_DRAWS):
        if stale:
            later = step(state.replace(key=later.key, step_count=later.step_count), action)
            stale = [name for name in stale if np.array_equal(new.obs[name], later.obs[name])]
    assert not stale, (
        f"obs {stale[0]!r} draws the same numbers in every step: split state.key in step and return the other half; "
        "keep what an episode draws once in physics"
    )


def check_failure(step: _Step, state: State, action: Array) -> None:
    """Checks that a step with NaN in the physics or in the action fails, unless nothing of its result is non-finite."""

    def spoilt(tree: PyTree) -> PyTree:
        return jax.tree.map(lambda a: a * jnp.nan if jnp.issubdtype(a.dtype, jnp.floating) else a, tree)

    for what, new in (
        ("whose physics is NaN", step(state.replace(physics=spoilt(state.physics)), action)),
        ("with an action of NaN", step(state, spoilt(action))),
    ):
        result = all(np.isfinite(a).all() for a in _floats((new.physics, new.obs, new.reward)))
        failed = bool(new.terminated) and bool(int(new.status) & FATAL)
        assert result or failed, (
            f"a step {what} does not end the episode with Status.NAN: build the state with next_state, which does"
        )
        assert finite(new.reward), f"a step {what} has a reward that is not finite: give 0 there, as next_state does"


def check_purity(env: Env, step: _Step, state: State, action: Array, new: State, tolerance: float) -> None:
    """Checks that a step depends on state and action only, and that ``jit`` does not change its result."""
    pure = (
        "let step depend on state and action alone: no Python state, no numpy random numbers, no callbacks that count"
    )
    check_same(step(state, action), new, 0.0, "two steps from one state", pure)
    check_same(new, env.step(state, action), tolerance, "jit(step) and step", pure)


def check_vmap(env: Env, reset: _Reset, step: _Step, key: Key, tolerance: float) -> None:
    """Checks that each of three environments in a batch gives the results that it gives alone."""
    keys, actions = jax.random.split(key, 3), jax.vmap(lambda k: random_action(env, k))(jax.random.split(key, 3))
    leaves = EnvLeaves.of(env)

    def one(leaves: EnvLeaves, key: Key, action: Array) -> State:
        env = leaves.build()
        return env.step(env.reset(key), action)

    batch = named("step", jax.jit(jax.vmap(one, in_axes=(None, 0, 0))), leaves, keys, actions)
    alone = "let an environment depend on itself only: nothing shared, no mean over a batch"
    for i in range(3):
        row = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
        what = "vmap of reset and step, and a loop over them,"
        check_same(row, step(reset(keys[i]), actions[i]), tolerance, what, alone)


def check_action_bounds(env: Env, step: _Step, state: State) -> None:
    """Checks that an action beyond a bound gives the same step as the action at the bound, to the bit.

    One compiled program gives the same bits for the same input, and a tolerance would hide a weak action.
    """
    spec = env.action_spec
    for bound, direction in ((spec.low, -1.0), (spec.high, 1.0)):
        beyond = step(state, jnp.full(spec.shape, bound + direction * 10.0 * (spec.high - spec.low)))
        check_values(env, beyond, "step with an action beyond its bounds")
        what = f"steps with an action beyond its bound {bound} and at it"
        check_same(beyond, step(state, jnp.full(spec.shape, bound)), 0.0, what, "clip the action in step")


_NOT_TRUNCATED = (
    "the episode is not truncated at episode_length {}: set truncated where step_count reaches it, as next_state does"
)


def check_episode(env: Env, step: _Step, state: State, key: Key) -> None:
    """Checks status, values, step count and end flags of one episode, and that a step after its end does not reset."""
    length, first = env.episode_length, state
    for count in range(1, length + 1):
        before, action = state, random_action(env, jax.random.fold_in(key, count))
        state = step(before, action)
        bits = int(state.status)
        assert not bits & FATAL, (
            f"step {count} of random actions fails numerically ({describe(bits)}): give {remedy(bits)}"
        )
        check_values(env, state, f"step {count}")
        both = bool(state.terminated & state.truncated)
        assert not both, f"step {count} is both terminated and truncated: terminated wins, truncated is then false"
        reached = int(state.step_count)
        assert reached == count, (
            f"step_count is {reached} after {count} steps: step must not reset, AutoReset does that"
        )
        early = bool(state.truncated) and count < length
        assert not early, (
            f"the episode is truncated at step {count}, before episode_length {length}: set terminated, or a shorter "
            "episode_length"
        )
        if bool(state.terminated):
            _check_limit(step, first, random_action(env, jax.random.fold_in(key, 1)), length)
            _check_limit(step, before, action, length)
            return
    assert bool(state.truncated), _NOT_TRUNCATED.format(length)
    beyond = int(step(state, random_action(env, key)).step_count)
    assert beyond == length + 1, "step resets after the end of an episode: leave that to AutoReset"


def _check_limit(step: _Step, state: State, action: Array, length: int) -> None:
    """Checks the flags of a step that is moved to the time limit, for episodes that end before it."""
    late = step(state.replace(step_count=jnp.int32(length - 1)), action)
    if int(late.step_count) != length:  # the environment counts by itself
        return
    both = bool(late.terminated & late.truncated)
    assert not both, "a step is both terminated and truncated at the time limit: terminated wins, truncated is false"
    assert bool(late.terminated | late.truncated), _NOT_TRUNCATED.format(length)


def _floats(tree: PyTree) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]


def check_same(a: PyTree, b: PyTree, tolerance: float, what: str, remedy: str, *, of: str = "the state") -> None:
    """Checks that two pytrees agree: integers and keys exactly, floats within a tolerance.

    The absolute tolerance of a floating-point leaf is ``tolerance * max(1, max(abs(leaf)))``, by its finite numbers.
    The others have to be equal; NaN equals NaN.
    """
    assert jax.tree.structure(a) == jax.tree.structure(b), f"{what} return different structures: {remedy}"
    for (path, x), y in zip(jax.tree.leaves_with_path(a), jax.tree.leaves(b), strict=True):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        x, y = np.asarray(x), np.asarray(y)
        if jnp.issubdtype(x.dtype, jnp.floating):
            finite = np.isfinite(y)
            slack = tolerance * max(1.0, np.max(np.abs(y[finite]), initial=0.0))
            same = np.allclose(x[finite], y[finite], rtol=0.0, atol=slack)
            same &= np.array_equal(x[~finite], y[~finite], equal_nan=True)
        else:
            same = np.array_equal(x, y)
        assert same, f"{what} differ in {jax.tree_util.keystr(path)} of {of}: {remedy}"
