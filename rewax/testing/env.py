"""``check_env``: the list of checks of an environment and their order."""

from collections.abc import Callable

import jax

from rewax.envs.base import Env
from rewax.envs.registry import require_env
from rewax.testing import functions, states
from rewax.testing.gradient import ActionGradient
from rewax.testing.progress import Progress
from rewax.testing.traced import random_action, traced_reset, traced_step

_JIT_TOLERANCE = 1e-3
"""Tolerance relative to the largest number of an array, or to 1 if that is smaller. A compiled program may fuse and
reorder sums in float32, and stiff material amplifies the difference: to 2e-4 in a step of HandLift."""
GRADIENT_TOLERANCE = 0.1
"""Relative tolerance. Central differences through contact are no more accurate than this in float32."""


def check_env(
    env: Env,
    *,
    seed: int = 0,
    tolerance: float = _JIT_TOLERANCE,
    check_full_episode: bool = True,
    gradient_steps: int = 3,
    gradient_tolerance: float | None = GRADIENT_TOLERANCE,
    notify: Callable[[str], None] | None = print,
) -> None:
    """Check an environment against the protocol of ``rewax.envs.base.Env``.

    It checks that

    - the environment is a pytree of arrays and numbers;
    - observations match their spec, and states keep their structure, so that ``lax.scan`` can carry them;
    - ``reset`` depends on its key only, and ``step`` on state and action only. It passes if all episodes begin with the
      same numbers, and says so;
    - ``jit`` and ``vmap`` change results by rounding only;
    - ``step`` keeps keys of different states different, and an observation that depends on the key draws anew in each
      step;
    - the first steps set no bit of ``status``, and a step with NaN in the physics or in the action ends the episode
      with a fatal one;
    - ``step`` clips actions, to the bit, never resets, truncates exactly at ``episode_length``, and never truncates a
      state that terminates;
    - the gradient of the reward with respect to the actions is finite and not zero. It and that of each observation,
      but of sensors, agree with central differences along two directions, and along the components in which it is
      exactly zero, unless differences of five sizes do not agree with each other;
    - the results of ``particles`` and ``render_shapes`` can be drawn.

    Args:
      env: unbatched environment, without ``AutoReset``.
      seed: seed of initial states and actions.
      tolerance: largest difference by rounding within one step, relative to the largest number of an array, or to 1 if
        that is smaller.
      check_full_episode: also run to ``episode_length``, which may take long.
      gradient_steps: number of steps after a reset within which some action must change some reward.
      gradient_tolerance: largest relative difference of a derivative from a central difference; None: not compared. Use
        None where ``stop_gradient`` or a custom derivative changes a gradient on purpose.
      notify: called with a line before each part, because compiling takes a while; None: silence.

    Raises:
      AssertionError: a sentence that names what is wrong, and what helps.
      ValueError: gradient_steps is below 1, or env is no environment.

    Example:
      >>> check_env(rewax.make("RollingFlat", scale="small"))
    """
    if gradient_steps < 1:
        raise ValueError(f"gradient_steps is {gradient_steps}: use 1 or more")
    require_env(env)
    say, key = Progress(f"check_env {type(env).__name__}", notify), jax.random.key(seed)
    say("specs and parameters")
    states.check_specs(env)
    states.check_leaves(env)
    say("compiling reset and step")
    reset, step = traced_reset(env), traced_step(env)
    state = reset(key)
    states.check_first_state(env, state)
    functions.check_reset_key(reset, state, key, say)
    action = random_action(env, jax.random.fold_in(key, 1))
    new = step(state, action)
    states.check_next_state(env, state, new)
    for source, each in (("reset", state), ("step", new)):
        states.check_pictures(env, each, source)
    say("repeated, and without jit")
    functions.check_purity(env, step, state, action, new, tolerance)
    functions.check_action_bounds(env, step, state)
    functions.check_step_key(step, state, action, new)
    say("three side by side")
    functions.check_vmap(env, reset, step, key, tolerance)
    say(f"gradient through {gradient_steps} steps")
    gradient = ActionGradient(env, state, key, gradient_steps)
    gradient.check()
    if gradient_tolerance is not None:
        say("differences of reward and observations")
        gradient.check_differences(new, gradient_tolerance, say)
    if check_full_episode:
        say(f"an episode of {env.episode_length} steps")
        functions.check_episode(env, step, state, key)
    functions.check_failure(step, state, action)
    say("passed")
