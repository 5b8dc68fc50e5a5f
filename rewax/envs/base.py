"""What an environment is: a pytree with ``reset`` and ``step``, pure functions of one episode."""

import dataclasses
import math
from typing import Protocol, TypeAlias

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.status import FATAL, Status, all_finite, flag
from rewax.types import Array, Key, Observation, PyTree

NO_LEAF = -1
"""``State.failed_leaf`` of a step that did not fail."""


@struct.dataclass
class State(struct.Replaceable):
    """One environment between two control steps.

    Attributes:
      physics: whatever the environment simulates (pytree).
      obs: named observations of this state.
      reward: reward of the step that led here, shape (); 0 after a reset.
      terminated: the episode ended for good (value 0 from here), shape (), bool.
      truncated: the episode ended by its time limit (value continues), shape (), bool; never set with terminated.
      metrics: named scalars to log, the same keys after every step.
      step_count: control steps since the reset, shape (), int32.
      status: bits of ``rewax.status.Status``, shape (), int32.
      key: this environment's source of randomness.
      final_obs: None, except behind the auto-reset wrapper: observation before the reset at the end of an episode,
        equal to ``obs`` elsewhere.
      drawn: leaves of the environment that belong to this episode, by name; None where nothing is randomised (see
        ``rewax.envs.Randomized``).
      failed_leaf: which array of the last step held a non-finite number, see ``failed_leaf_name``; -1: none, shape (),
        int32.
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
    failed_leaf: Array = struct.field(default_factory=lambda: jnp.full((), NO_LEAF, jnp.int32))

    @property
    def done(self) -> Array:
        """The episode ended, one way or the other, shape (), bool."""
        return self.terminated | self.truncated


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """Arrays of one shape with bounds, the same for all components.

    Attributes:
      shape: of one environment's array.
      low, high: bounds, both inclusive; infinite by default.
    """

    shape: tuple[int, ...]
    low: float = -math.inf
    high: float = math.inf


Spec: TypeAlias = ArraySpec | dict[str, ArraySpec]


class Env(Protocol):
    """An environment: a pytree whose leaves are physical parameters, with pure, unbatched methods.

    Batch with ``jax.vmap``, differentiate with ``jax.grad`` (also with respect to the environment itself), compile
    with ``jax.jit``. ``rewax.testing.check_env`` checks an implementation against this protocol.
    """

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        """Shapes and bounds of the observations."""
        ...

    @property
    def action_spec(self) -> ArraySpec:
        """Shape and bounds of an action: by convention within [-1, 1]; ``step`` clips."""
        ...

    @property
    def episode_length(self) -> int:
        """Control steps until an episode is truncated."""
        ...

    def reset(self, key: Key) -> State:
        """The beginning of an episode. Gradient: exact with respect to the environment's leaves."""
        ...

    def step(self, state: State, action: Array) -> State:
        """One control step, without reset at the end of an episode. Gradient: exact, through the physics."""
        ...


def first_state(*, physics: PyTree, obs: Observation, metrics: dict[str, Array], key: Key) -> State:
    """A ``State`` for the beginning of an episode."""
    return State(
        physics=physics,
        obs=obs,
        reward=jnp.zeros((), jax.tree.leaves(obs)[0].dtype),
        terminated=jnp.zeros((), bool),
        truncated=jnp.zeros((), bool),
        metrics=metrics,
        step_count=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.int32),
        key=key,
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
    """The ``State`` after a control step, with time limit and numerical failures taken care of.

    If physics, observation or reward hold a non-finite number, the bit ``Status.NAN`` is set, the episode is terminated
    with reward 0, and physics, observation and metrics keep their previous, finite values; no gradient flows.

    Args:
      state: before the step.
      physics, obs, reward, metrics: after it.
      episode_length: step at which the episode is truncated, unless it terminates there.
      terminated: the task's own end of the episode, shape (), bool.
      status: bits found by the physics.

    Gradient: passes through unchanged, cut in a failed step. (A NaN in the derivative of a failed step itself cannot be
      removed here; agents drop such an environment's gradient and count it.)
    """
    broken = [~all_finite(leaf) for leaf in _checked_leaves(physics, obs, reward)]
    # A fatal status without a non-finite number has the index after the last array's.
    broken = jnp.stack([*broken, (jnp.asarray(status) & FATAL) != 0])
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
        status=jnp.asarray(status, jnp.int32) | flag(failed, Status.NAN),
        failed_leaf=jnp.where(failed, first, NO_LEAF),
    )


def failed_leaf_name(env: "Env", leaf: int) -> str:
    """What ``State.failed_leaf`` stands for: ``"physics.rigid.qpos"``, ``"obs['state']"``, ``"reward"``.

    Args:
      env: the environment, unbatched.
      leaf: the index; after the last array it stands for a fatal bit of ``status``, below 0 for nothing.
    """
    state = jax.eval_shape(env.reset, jax.random.key(0))
    parts = {"physics": state.physics, "obs": dict(state.obs), "reward": state.reward}
    names = [
        name + jax.tree_util.keystr(path)
        for name, tree in parts.items()
        for path, value in jax.tree.leaves_with_path(tree)
        if jnp.issubdtype(value.dtype, jnp.inexact)
    ]
    return "nothing" if leaf < 0 else names[leaf] if leaf < len(names) else "status"


def _checked_leaves(physics: PyTree, obs: Observation, reward: Array) -> list[Array]:
    """Arrays that must be finite, in the order that ``failed_leaf_name`` names."""
    leaves = [*jax.tree.leaves(physics), *jax.tree.leaves(dict(obs)), reward]
    return [leaf for leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)]
