"""Compiled programs for evaluation and for recordings. A thread compiles them while ``train_step`` runs."""

import contextlib
import functools
import importlib
import threading
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from rewax.envs.base import Env
from rewax.envs.memory import MEMORY, initial_memory, remembered, with_memory_of
from rewax.training.config import ReportConfig
from rewax.training.evaluation.cameras import as_recorded
from rewax.training.evaluation.episodes import Policy, make_evaluate, uniform_policy, with_step
from rewax.training.evaluation.recording import can_record, make_record
from rewax.types import Key

MODES = ("sampled", "deterministic", "no action", "random actions")
"""Evaluation modes: the policy with sampled and with deterministic actions, and two baselines."""


class Programs:
    """Evaluates and records episodes. Each program is compiled once, in the background or at its first use.

    Args:
      env: unbatched environment.
      policy: ``Agent.policy``.
      config: report configuration of the run.
      compiler_options: of ``jax.jit`` for the evaluation.
    """

    def __init__(
        self, env: Env, policy: Policy, config: ReportConfig, compiler_options: Mapping[str, Any] | None = None
    ) -> None:
        self._env, self._policy, self._config = env, policy, config
        modes = any_of(env, policy)
        self._evaluate = make_evaluate(env, modes, config.num_eval_episodes, compiler_options=compiler_options)
        self._evaluates, self._thread = threading.Event(), None
        self._evaluates.set()

    def evaluate(self, train_state: Any, mode: str, key: Key) -> dict[str, Any]:
        """Evaluate one of ``MODES``."""
        self._evaluates.wait()  # until the thread has compiled this program
        return self._evaluate((train_state, MODES.index(mode)), key)

    def record(self, train_state: Any, key: Key, name: str) -> Any:
        """Record a deterministic episode."""
        self.wait()
        return self._recorder(train_state, key, name)

    def compile_in_background(self, train_state: Any, key: Key) -> None:
        """Compile both programs in a thread, the evaluation first, for training states shaped like this one. Once.

        The recording is compiled only if plots are on and the environment can be drawn. A compilation error is raised
        at the program's first use.
        """
        if self._thread is not None:
            return
        self._evaluates.clear()
        self._thread = threading.Thread(target=self._compile, args=(train_state, key), name="rewax-programs")
        self._thread.start()

    def wait(self) -> None:
        """Wait until the thread has ended, if there is one."""
        if self._thread is not None:
            self._thread.join()

    @functools.cached_property
    def _recorder(self) -> Any:
        return make_record(as_recorded(self._env), self._policy)

    def _compile(self, train_state: Any, key: Key) -> None:
        try:
            with contextlib.suppress(Exception):
                self._evaluate.lower((train_state, 0), key).compile()  # pyright: ignore[reportFunctionMemberAccess]
        finally:
            self._evaluates.set()
        if self._config.plots and can_record(self._env):
            with contextlib.suppress(Exception):
                self._recorder(train_state, key, "", max_steps=1)
        if self._config.plots:
            importlib.import_module("rewax.viz.plots")  # matplotlib is slow to import


def any_of(env: Env, policy: Policy) -> Policy:
    """A policy that selects one of ``MODES`` at run time, so that all of them share one compiled program.

    Its first argument is ``(train_state, mode)``, where ``mode`` is an index into ``MODES``.
    """
    random, policy_at = uniform_policy(env), with_step(policy)
    remembers = initial_memory(policy) is not None

    def choose(state_and_mode: Any, obs: Any, key: Key, deterministic: bool = False, step: Any = 0) -> Any:
        train_state, mode = state_and_mode
        shape, dtype = env.action_spec.shape, jnp.result_type(float)

        def learnt(deterministic: bool) -> Any:
            return jax.tree.map(lambda a: a.astype(dtype), policy_at(train_state, obs, key, step, deterministic))

        def baseline(action: jax.Array) -> Any:
            return remembered(action.astype(dtype), obs[MEMORY].astype(dtype) if remembers else None)

        branches = (
            lambda: learnt(False),
            lambda: learnt(True),
            lambda: baseline(jnp.zeros(shape, dtype)),
            lambda: baseline(random(None, obs, key)),
        )
        return jax.lax.switch(mode, branches)

    return with_memory_of(policy, choose)


__all__ = ["MODES", "Programs", "any_of"]
