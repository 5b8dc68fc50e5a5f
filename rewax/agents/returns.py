"""Returns along one trajectory; time is the leading axis, ``vmap`` over environments."""

import jax
import jax.numpy as jnp

from rewax.types import Array


def stretch_ends(done_t: Array, valid_t: Array) -> Array:
    """Where a stretch of steps that belong together ends, shape (T,), bool.

    At the end of an episode, at the last step, and before a step that failed: what that step would have earned is
    unknown, so the value of the state before it stands for it.

    Args:
      done_t: whether the step ended an episode, shape (T,).
      valid_t: whether the step succeeded, shape (T,).
    """
    return done_t.at[-1].set(True) | ~jnp.append(valid_t[1:], True)


def td_lambda(
    r_t: Array, v_tp1: Array, done_t: Array, valid_t: Array | None = None, *, discount: float, lambda_: float
) -> Array:
    """TD(lambda) targets of a stretch that may hold several episodes.

    G_t = r_t + discount * (v_tp1 if the episode ends at t or t is last, else (1 - lambda) v_tp1 + lambda G_tp1).

    Args:
      r_t: rewards, shape (T,).
      v_tp1: value of the state each step leads to, before any reset, and 0 where it is terminal, shape (T,).
      done_t: whether the step ended an episode, terminated or truncated, shape (T,).
      valid_t: whether the step succeeded, shape (T,); None: all did. A failed step has no part in the targets of
        those before it (``stretch_ends``); its own is meaningless.
      discount: gamma [-].
      lambda_: 0 bootstraps after one step, 1 at the end of the stretch.

    Returns:
      Targets, shape (T,). Gradient: exact.
    Source: Sutton and Barto 2018, eq. 12.18; equal to the recursion of DiffRL and SAPO.
    """
    end_t = stretch_ends(done_t, jnp.ones_like(done_t) if valid_t is None else valid_t)

    def backward(g_tp1: Array, inputs: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        r, v, end = inputs
        g = r + discount * jnp.where(end, v, (1.0 - lambda_) * v + lambda_ * g_tp1)
        return g, g

    return jax.lax.scan(backward, jnp.zeros_like(v_tp1[-1]), (r_t, v_tp1, end_t), reverse=True)[1]


def short_horizon_return(
    r_t: Array, v_tp1: Array, done_t: Array, valid_t: Array | None = None, *, discount: float
) -> Array:
    """What a first-order agent ascends: discounted rewards of each stretch of an episode, plus the value at its end.

    The discount starts anew after each end of an episode; the last step of the horizon ends a stretch too.

    Args:
      r_t: rewards, shape (T,).
      v_tp1: value of the state each step leads to, before any reset, and 0 where it is terminal, shape (T,).
      done_t: whether the step ended an episode, shape (T,).
      valid_t: whether the step succeeded, shape (T,); None: all did. A failed step counts for nothing, and the stretch
        before it ends with the value of the state that it started from.
      discount: gamma [-].

    Returns:
      The sum over all stretches, shape (). Gradient: exact.
    Source: Xu et al. 2022, SHAC, eq. 5.
    """
    valid_t = jnp.ones_like(done_t) if valid_t is None else valid_t
    end_t = stretch_ends(done_t, valid_t)

    def forward(weight: Array, inputs: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        r, v, end, valid = inputs
        gained = weight * (r + jnp.where(end, discount * v, 0.0))
        return jnp.where(end, 1.0, weight * discount), jnp.where(valid, gained, 0.0)

    return jax.lax.scan(forward, jnp.ones_like(r_t[0]), (r_t, v_tp1, end_t, valid_t))[1].sum()
