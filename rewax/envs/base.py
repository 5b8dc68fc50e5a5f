"""The environment protocol: a pytree with ``reset`` and ``step``, pure functions of one unbatched episode."""

import dataclasses
import math
from typing import Protocol, TypeAlias

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.status import FATAL, Status, all_finite, flag
from rewax.types import Array, Key, Observation, PyTree

NO_LEAF = -1
"""The value of ``State.failed_leaf`` after a step that did not fail."""
SENSOR_LEAF = 2**30
"""The value of ``State.failed_leaf`` after a step in which a sensor of ``Sensing`` observed a non-finite number."""
MEMORY_LEAF = SENSOR_LEAF // 2
"""The value of ``State.failed_leaf`` after a step in which a policy returned a memory that is not finite."""
_ADDED = {SENSOR_LEAF: "the observation of a sensor", MEMORY_LEAF: "the memory of the policy"}


@struct.dataclass
class State(struct.Replaceable):
    """One environment between two control steps.

    Attributes:
      physics: state of the simulation (pytree).
      obs: named observations of this state.
      reward: reward of the step that led to this state, shape (); 0 after a reset.
      terminated: the episode ended, and the value of this state is 0, shape (), bool.
      truncated: the episode reached its time limit, and the value of this state is not 0, shape (), bool. It is never
        set together with terminated.
      metrics: named scalars to log, the same keys after every step.
      step_count: control steps since the reset, shape (), int32.
      status: bits of ``rewax.status.Status``, shape (), int32.
      key: this environment's source of randomness.
      final_obs: the observation before the reset that ``AutoReset`` made at the end of an episode, equal to ``obs`` at
        other steps; None without ``AutoReset``.
      drawn: parameters of the environment that were drawn for this episode, by name; None where nothing is randomised
        (see ``rewax.envs.Randomized``).
      delayed: observations and actions that are on their way; None without ``rewax.envs.latency.Latency``.
      failed_leaf: index of the first array that held a non-finite number in the last step or reset, -1 for none,
        shape (), int32. ``failed_leaf_name`` gives its name.
    """

    physics: PyTree
    obs: Observation
    reward: Array
    terminated: Array
    truncated: Array
    metrics: dict[str, Array]
    step_count: Array
    status: Array
    key: Key
    final_obs: Observation | None = None
    drawn: dict[str, Array] | None = None
    delayed: PyTree = None
    failed_leaf: Array = struct.field(default_factory=lambda: jnp.full((), NO_LEAF, jnp.int32))

    @property
    def done(self) -> Array:
        """Whether the episode terminated or was truncated, shape (), bool."""
        return self.terminated | self.truncated


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """Shape and bounds of an array. All components have the same bounds.

    Attributes:
      shape: shape of the array of one environment.
      low, high: inclusive bounds; infinite by default.
    """

    shape: tuple[int, ...]
    low: float = -math.inf
    high: float = math.inf


Spec: TypeAlias = ArraySpec | dict[str, ArraySpec]


class Env(Protocol):
    """An environment: a pytree of physical parameters with pure, unbatched methods.

    Batch with ``jax.vmap``, differentiate with ``jax.grad`` (also with respect to the environment itself), compile
    with ``jax.jit``. ``rewax.testing.check_env`` checks an implementation against this protocol.
    """

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        """Shapes and bounds of the observations."""
        ...

    @property
    def action_spec(self) -> ArraySpec:
        """Shape and bounds of an action, by convention [-1, 1]. ``step`` clips actions to the bounds."""
        ...

    @property
    def episode_length(self) -> int:
        """Control steps until an episode is truncated."""
        ...

    def reset(self, key: Key) -> State:
        """The first state of an episode.

        Gradient: exact with respect to the parameters of the environment, except bounds of noise whose draws are
          rounded (``rewax.envs.kit.start_noise``).
        """
        ...

    def step(self, state: State, action: Array) -> State:
        """The state after one control step; ``step`` never resets. Gradient: exact, through the physics."""
        ...


def first_state(*, physics: PyTree, obs: Observation, metrics: dict[str, Array], key: Key) -> State:
    """The ``State`` at the beginning of an episode: reward 0, step 0, status ``OK``.

    The status is ``Status.NAN`` if physics or observation hold a non-finite number. Such a state has not terminated.
    Its first step fails if the observation was not finite, or if physics still is not.

    Args:
      physics, obs, metrics: of the first state; ``metrics`` has the names of every later step.
      key: the randomness that steps use.

    Gradient: passes through unchanged.
    """
    kinds = (leaf.dtype for leaf in jax.tree.leaves(obs) if jnp.issubdtype(leaf.dtype, jnp.floating))
    reward = jnp.zeros((), next(kinds, jnp.result_type(float)))
    not_finite = jnp.stack([~all_finite(leaf) for leaf in _checked_leaves(physics, obs, reward)])
    failed = not_finite.any()
    return State(
        physics=physics,
        obs=obs,
        reward=reward,
        terminated=jnp.zeros((), bool),
        truncated=jnp.zeros((), bool),
        metrics=metrics,
        step_count=jnp.zeros((), jnp.int32),
        status=flag(failed, Status.NAN),
        key=key,
        failed_leaf=jnp.where(failed, jnp.argmax(not_finite).astype(jnp.int32), NO_LEAF),
    )


def next_state(
    state: State,
    *,
    physics: PyTree,
    obs: Observation,
    reward: Array,
    metrics: dict[str, Array],
    episode_length: int,
    terminated: Array | bool = False,
    status: Array | int = 0,
) -> State:
    """The ``State`` after a control step. Truncates at the time limit and ends episodes that fail numerically.

    A step fails if physics, observation, reward or the observation before it hold a non-finite number, which sets
    ``Status.NAN``, or if ``status`` has a fatal bit. Then the episode terminates with reward 0, and physics,
    observation and metrics keep their previous values, which are finite unless those of the reset were not; no gradient
    flows.

    Args:
      state: the state before the step.
      physics, obs, reward, metrics: their values after the step.
      episode_length: the step at which the episode is truncated, unless it terminates there.
      terminated: whether the task ends the episode, shape (), bool.
      status: bits that the physics set.

    Gradient: passes through unchanged; cut in a failed step. The derivative of a failed step may itself hold a NaN,
      which cannot be removed here: agents drop the gradient of such an environment and count it.
    """
    # An observation that is not finite is that of a reset. What a policy did with it is no data.
    before = [~all_finite(leaf) for leaf in _checked_leaves((), state.obs, state.reward)]
    after = [~all_finite(leaf) for leaf in _checked_leaves(physics, obs, reward)]
    num = len(after) - len(before)
    not_finite = jnp.stack([*after[:num], *(a | b for a, b in zip(after[num:], before, strict=True))])
    # A fatal status without a non-finite number has the index after the last array's.
    broken = jnp.append(not_finite, (jnp.asarray(status) & FATAL) != 0)
    first = jnp.min(jnp.where(broken, jnp.arange(len(broken), dtype=jnp.int32), len(broken)))
    failed = first < len(broken)

    def keep(new: PyTree, old: PyTree) -> PyTree:
        return jax.tree.map(lambda a, b: jnp.where(failed, jax.lax.stop_gradient(b), a), new, old)

    step_count = state.step_count + 1
    terminated = jnp.asarray(terminated) | failed
    return state.replace(
        physics=keep(physics, state.physics),
        obs=keep(dict(obs), dict(state.obs)),
        reward=jnp.where(failed, 0.0, reward),
        terminated=terminated,
        truncated=~terminated & (step_count >= episode_length),
        metrics=keep(metrics, state.metrics),
        step_count=step_count,
        status=jnp.asarray(status, jnp.int32) | flag(not_finite.any(), Status.NAN),
        failed_leaf=jnp.where(failed, first, NO_LEAF),
    )


def with_observations(state: State, added: Observation, before: Observation, *, leaf: int) -> State:
    """The state after a step, with observations that a wrapper adds. One that is or was not finite fails the step.

    Args:
      state: the state of the wrapped environment after the step.
      added: the further observations.
      before: observations before the step, which those of a failed step keep.
      leaf: the value of ``State.failed_leaf`` if this fails the step.

    Gradient: passes through; cut where the added observations fail.
    """
    failed = ~all_finite((added, {name: before[name] for name in added}))
    added = {name: jnp.where(failed, jax.lax.stop_gradient(before[name]), value) for name, value in added.items()}
    return state.replace(
        obs={**state.obs, **added},
        reward=jnp.where(failed, 0.0, state.reward),
        terminated=state.terminated | failed,
        truncated=state.truncated & ~failed,
        status=state.status | flag(failed, Status.NAN),
        failed_leaf=jnp.where(failed & (state.failed_leaf == NO_LEAF), leaf, state.failed_leaf),
    )


def with_first_observations(state: State, added: Observation, *, leaf: int) -> State:
    """The first state of an episode, with observations that a wrapper adds; its status as of ``first_state``.

    Args:
      state: the first state of the wrapped environment.
      added: the further observations.
      leaf: the value of ``State.failed_leaf`` if one of these is not finite, and nothing else.
    """
    failed = ~all_finite(added)
    return state.replace(
        obs={**state.obs, **added},
        status=state.status | flag(failed, Status.NAN),
        failed_leaf=jnp.where(failed & (state.failed_leaf == NO_LEAF), leaf, state.failed_leaf),
    )


def failed_leaf_name(env: "Env", leaf: int) -> str:
    """The name of the array with index ``State.failed_leaf``: ``"physics.rigid.qpos"``, ``"obs['state']"``.

    Args:
      env: the environment, unbatched.
      leaf: the index. A negative one gives ``"nothing"``, one beyond the last array ``"status"``: a fatal bit.
        What wrappers add has names of its own: ``"the observation of a sensor"``, ``"the memory of the policy"``.
    """
    state = jax.eval_shape(env.reset, jax.random.key(0))
    own = jax.eval_shape(getattr(env, "unwrapped", env).reset, jax.random.key(0)).obs  # wrappers add further ones
    parts = {"physics": state.physics, "obs": dict(own), "reward": state.reward}
    names = [
        name + jax.tree_util.keystr(path)
        for name, tree in parts.items()
        for path, value in jax.tree.leaves_with_path(tree)
        if jnp.issubdtype(value.dtype, jnp.inexact)
    ]
    if leaf in _ADDED:
        return _ADDED[leaf]
    return "nothing" if leaf < 0 else names[leaf] if leaf < len(names) else "status"


def _checked_leaves(physics: PyTree, obs: Observation, reward: Array) -> list[Array]:
    """The arrays that must be finite, in the order of the names in ``failed_leaf_name``."""
    leaves = [*jax.tree.leaves(physics), *jax.tree.leaves(dict(obs)), reward]
    return [jnp.asarray(leaf) for leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)]
