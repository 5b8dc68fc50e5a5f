"""The check of an agent: what is checked, in which order."""

from collections.abc import Callable, Collection

import jax

from rewax.agents.base import Agent
from rewax.envs.base import Env
from rewax.testing import agent_policy, agent_states
from rewax.testing.progress import Progress

_TOLERANCE = 1e-2
"""Relative. Another program rounds differently, and Adam turns the sign of a gradient near zero into a full step."""


def check_agent(
    agent: Agent,
    env: Env,
    *,
    seed: int = 0,
    tolerance: float = _TOLERANCE,
    may_be_nan: Collection[str] = ("return",),
    notify: Callable[[str], None] | None = print,
) -> None:
    """Check an agent against the protocol of ``rewax.agents.base.Agent``.

    ``init`` depends on its key alone, ``train_step`` on its state alone: the same input gives the same bytes.
    ``train_step`` keeps structure, shapes and dtypes of the state, so that ``lax.scan`` can carry it; it counts
    ``iteration`` and ``env_steps``. Its metrics are finite scalars under the same names in every iteration, those
    that the training loop needs among them. Both functions can be compiled and mapped over seeds, and each seed's
    result is that of its run alone. ``policy`` returns actions with the shape and within the bounds of
    ``action_spec``; ``deterministic=True`` does not depend on the key; ``vmap`` gives what a loop gives. If the state
    has the field ``environments`` (``rewax.agents.run_state.RunState``), one environment is made to fail: what was
    finite in the rest of the state must stay finite.

    Runs six iterations and compiles ``train_step`` three times: use a small configuration.

    Args:
      agent: what ``make_...(env, config)`` returned.
      env: the environment that it is bound to.
      seed: of the runs.
      tolerance: relative difference that another compilation of the same iteration may make.
      may_be_nan: names of metrics that may be NaN. ``return`` is, as long as no episode has ended.
      notify: gets a line before each part, as compiling takes a while; None: silence.

    Raises:
      AssertionError: a sentence that names what is wrong, and what helps.

    Example:
      >>> check_agent(make_sapo(env, SAPOConfig(num_envs=4, horizon=4)), env)
    """
    say, key = Progress(f"check_agent {getattr(agent, 'name', '')}".rstrip(), notify), jax.random.key(seed)
    agent_states.check_parts(agent)
    say("compiling init and train_step")
    state = agent_states.check_init(agent, key)
    after = agent_states.check_train_step(agent, state, key, may_be_nan)
    say("repeated, and compiled anew")
    agent_states.check_repeats(agent, key, after)
    agent_states.check_compiled_anew(agent, key, after, tolerance)
    say("two seeds side by side")
    agent_states.check_seeds(agent, key, tolerance)
    say("policy")
    agent_policy.check_policy(agent, env, agent.init(key), key, tolerance)
    say("a failing environment")
    agent_states.check_failure(agent, key)
    say("passed")
