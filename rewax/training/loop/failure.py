"""Failure detection: shares of failed episodes and of dropped gradients, non-finite critic loss or parameters."""

import itertools
import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.agents.replay import Replay
from rewax.envs.base import Env, State, failed_leaf_name
from rewax.status import FATAL, Status, all_finite, describe, remedy
from rewax.training.config import ReportConfig
from rewax.training.loop.devices import on_one_device

_NOT_LEARNT = (State, Replay)
_REMEDY = "shorter substeps, softer contacts and materials, or smaller learning rates help"
_GRADIENT_REMEDY = (
    "a shorter horizon or truncate_every helps if derivatives overflow, and rewax.testing.check_env finds NaN in them"
)


class _Iteration(NamedTuple):
    """Counts of one iteration.

    ``episodes`` is the larger of two numbers: ended episodes, and steps divided by the episode length. ``dropped`` is
    the number of environments whose gradient was left out of the mean.
    """

    failed: int
    episodes: float
    dropped: int
    bad_critics: bool


class FailureWatch:
    """Detects from a run's metrics that too many episodes fail, gradients are dropped, or critic losses are not finite.

    The share of failed episodes is computed over the last ``config.failure_window`` iterations. Failures end episodes
    early. Among ended episodes alone, a few failures would therefore outweigh the healthy episodes still running. The
    number of steps divided by the episode length accounts for running episodes.

    Args:
      env: environment of the run; it gives the episode length and the names of non-finite arrays.
      config: its ``max_failed_share`` and ``failure_window`` are used.
      num_envs: number of environments, each with a gradient; 0: not known, and dropped gradients stop no run.
    """

    def __init__(self, env: Env, config: ReportConfig, num_envs: int = 0) -> None:
        self._env, self._config, self._num_envs = env, config, num_envs
        self._recent: deque[_Iteration] = deque(maxlen=config.failure_window)
        self._culprit = ""
        self._warned: set[str] = set()
        self._resumes_failure = False

    def add(self, iteration: int, num_steps: int, metrics: Mapping[str, Any]) -> str:
        """Add an iteration.

        Args:
          iteration: its number.
          num_steps: environment steps of this iteration.
          metrics: ``failed_episodes``, ``episodes``, ``failed_env``, ``failed_leaf``, ``critic_loss``,
            ``dropped_gradients``. Each is optional.

        Returns:
          A warning at the first failed episode and at the first dropped gradient since this process began; otherwise
          an empty string.
        """
        failed = int(metrics.get("failed_episodes", 0))
        ended = max(int(metrics.get("episodes", 0)), failed)
        critics = [float(value) for name, value in metrics.items() if name == "critic_loss"]
        episodes = max(ended, num_steps / max(self._env.episode_length, 1))
        dropped = int(metrics.get("dropped_gradients", 0))
        self._recent.append(_Iteration(failed, episodes, dropped, not all(map(math.isfinite, critics))))
        warnings = {}
        if failed:
            self._culprit = _culprit(self._env, metrics)
            warnings["failed"] = f"{self._culprit}: {_REMEDY}"
        if dropped:
            one = "the gradient of 1 environment was not finite and was left out"
            several = f"the gradients of {dropped} environments were not finite and were left out"
            warnings["dropped"] = f"{one if dropped == 1 else several}: {_GRADIENT_REMEDY}"
        new = [f"warning: in iteration {iteration} {warnings[kind]}" for kind in warnings if kind not in self._warned]
        self._warned |= set(warnings)
        return "\n".join(new)

    def recall(self, columns: Mapping[str, np.ndarray], iteration: int) -> None:
        """Add the iterations before a resumed one, so that the run stops where it would have without the interruption.

        A run that had stopped because of failures begins with an empty window.

        Args:
          columns: of ``metrics.csv``.
          iteration: the one that the run continues from. Earlier ones count as far back as there is a row for each.
        """
        for row in _rows_before(columns, iteration, self._config.failure_window):
            self.add(int(row["iteration"]), int(row["num_steps"]), row)
        self._warned = set()
        if self.reason():
            self._recent.clear()
            self._resumes_failure = True

    @property
    def healthy(self) -> bool:
        """Whether there is no reason to stop, also before the window is full.

        The last iteration's shares of failed episodes and dropped gradients are checked on their own, too.
        """
        if not self._recent:
            return not self._resumes_failure
        last = self._recent[-1]
        dropped = self._num_envs and self._too_many(last.dropped, self._num_envs)
        return not (dropped or self._too_many(last.failed, last.episodes) or self.reason(final=True))

    def reason(self, *, final: bool = False) -> str:
        """Why the run should stop; an empty string if it should continue.

        Args:
          final: decide even if there were fewer than ``failure_window`` iterations so far.
        """
        seen = len(self._recent)
        if not seen or (seen < self._config.failure_window and not final):
            return ""
        limit = self._config.max_failed_share
        failed, episodes = sum(one.failed for one in self._recent), sum(one.episodes for one in self._recent)
        if self._too_many(failed, episodes):
            return (
                f"{failed} of {max(round(episodes), failed)} episodes failed numerically in the last {seen} iterations "
                f"(max_failed_share is {limit:g}); at last {self._culprit}: {_REMEDY}"
            )
        dropped, gradients = sum(one.dropped for one in self._recent), seen * self._num_envs
        if gradients and self._too_many(dropped, gradients):
            return (
                f"{dropped} of {gradients} gradients of environments were not finite in the last {seen} iterations "
                f"(max_failed_share is {limit:g}): {_GRADIENT_REMEDY}"
            )
        bad = sum(one.bad_critics for one in self._recent)
        if bad > limit * seen:
            where = f"in {bad} of the last {seen} iterations"
            return f"critic_loss was not finite {where}: smaller rewards or learning rates help"
        return ""

    def _too_many(self, failed: int, episodes: float) -> bool:
        return failed > self._config.max_failed_share * max(episodes, 1)


def _rows_before(columns: Mapping[str, np.ndarray], iteration: int, most: int) -> list[dict[str, float]]:
    """The last rows up to an iteration, in order, as far as each follows another. ``num_steps``: its control steps."""
    numbers = columns.get("iteration", np.zeros(0))
    rows: list[dict[str, float]] = []
    for i in range(len(numbers) - 1, -1, -1):
        number_before, before = (numbers[i - 1], columns["env_steps"][i - 1]) if i else (0, 0.0)
        if numbers[i] != iteration - len(rows) or number_before != numbers[i] - 1 or len(rows) == most:
            break
        row = {name: float(values[i]) for name, values in columns.items()}
        finite = {name: value for name, value in row.items() if math.isfinite(value) or name == "critic_loss"}
        rows.insert(0, {**finite, "num_steps": row["env_steps"] - before})
    return rows


class FiniteCheck:
    """Finds non-finite numbers in the floating-point leaves of an agent's training state.

    Environment states are not checked, because a reset replaces them. Replay buffers are not checked either. Leaves
    that are not finite at the beginning are never checked, and returns of episodes neither: NaN marks one that is not
    known.

    Args:
      train_state: training state at the beginning of the run.
    """

    def __init__(self, train_state: Any) -> None:
        named = jax.tree.leaves_with_path(train_state, is_leaf=_ends)
        self._checked = [_is_learnt(path, leaf) and _is_finite(leaf) for path, leaf in named]
        # On a CPU NumPy reads the arrays in place. XLA would compile a program, and gather them on one device.
        self._compiled = None if jax.default_backend() == "cpu" else jax.jit(all_finite)

    def first_bad(self, train_state: Any) -> str:
        """Name of the first leaf that is not finite, such as ``.critic_params['bias']``; empty if there is none."""
        leaves = list(itertools.compress(jax.tree.leaves(train_state, is_leaf=_ends), self._checked))
        if all(map(_is_finite, leaves)) if self._compiled is None else self._compiled(on_one_device(leaves)):
            return ""
        named = itertools.compress(jax.tree.leaves_with_path(train_state, is_leaf=_ends), self._checked)
        return next(jax.tree_util.keystr(path) for path, leaf in named if not _is_finite(leaf))


def _ends(node: Any) -> bool:
    """Environment states and replay buffers count as one leaf."""
    return isinstance(node, _NOT_LEARNT)


def _is_learnt(path: Any, leaf: Any) -> bool:
    """Floating-point numbers, no environment states, returns of episodes and replay buffers."""
    if _ends(leaf) or jax.tree_util.keystr(path) == ".environments.episode_return":
        return False
    return jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)


def _is_finite(leaf: Any) -> bool:
    if isinstance(leaf, jax.Array) and not (leaf.is_fully_addressable or leaf.is_fully_replicated):
        leaf = leaf.addressable_data(0)  # this process's shard
    return bool(np.all(np.isfinite(np.asarray(leaf))))


def _culprit(env: Env, metrics: Mapping[str, Any]) -> str:
    """A clause that names the failed environment and its non-finite array or fatal status, if the metrics have them."""
    index, leaf = int(metrics.get("failed_env", -1)), int(metrics.get("failed_leaf", -1))
    if index < 0 or leaf < 0:
        return "an environment failed because its physics, an observation or the reward was not finite"
    name = failed_leaf_name(env, leaf)
    if name != "status":
        return f"environment {index} failed because {name} was not finite"
    bits = sum(bit for bit in Status if bit & FATAL and metrics.get(f"status/{bit.name}", 0))
    what = f"was {describe(bits)} (give {remedy(bits)})" if bits else "had a fatal bit"
    return f"environment {index} failed because its status {what}"
