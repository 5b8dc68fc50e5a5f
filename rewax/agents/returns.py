"""Returns along one trajectory: TD(lambda), GAE, short horizons. Time is the leading axis; ``vmap`` over environments.

A trajectory consists of segments: steps of one episode without a failed step between them.
"""

import jax
import jax.numpy as jnp

from rewax.types import Array


def segment_ends(done_t: Array, valid_t: Array) -> Array:
    """Marks segment ends, shape (T,), bool: ends of episodes, the last step, and steps before one that failed.

    Returns bootstrap with the value of the state before a failed step, because its reward and next state are unknown.

    Args:
      done_t: whether the step ended an episode, shape (T,).
      valid_t: whether the step succeeded, shape (T,).
    """
    return done_t.at[-1].set(True) | ~jnp.append(valid_t[1:], True)


def td_lambda(
    r_t: Array, v_tp1: Array, done_t: Array, valid_t: Array | None = None, *, discount: float, lambda_: float
) -> Array:
    """TD(lambda) targets of a trajectory that may hold several episodes.

    G_t = r_t + discount * (v_tp1 if a segment ends at t, else (1 - lambda) v_tp1 + lambda G_tp1).

    G_t - V(s_t) is the advantage of generalised advantage estimation, GAE(lambda).

    Args:
      r_t: rewards, shape (T,).
      v_tp1: value of the state that step t leads to, before any reset; 0 if it is terminal, shape (T,).
      done_t: whether the step ended an episode, terminated or truncated, shape (T,).
      valid_t: whether the step succeeded, shape (T,); None: all did. A failed step does not enter the targets of
        earlier steps (``segment_ends``). Its own target is meaningless.
      discount: gamma [-].
      lambda_: 0 bootstraps after one step, 1 at the end of the segment.

    Returns:
      Targets, shape (T,). Gradient: exact.
    Source: Sutton and Barto 2018, eq. 12.18; advantages: Schulman et al. 2016, eq. 16. Equal to the recursion in the
      code of SHAC and SAPO.
    """
    end_t = segment_ends(done_t, jnp.ones_like(done_t) if valid_t is None else valid_t)

    def backward(g_tp1: Array, inputs: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        r, v, end = inputs
        # Sutton and Barto, eq. 12.18
        g = r + discount * jnp.where(end, v, (1.0 - lambda_) * v + lambda_ * g_tp1)
        return g, g

    return jax.lax.scan(backward, jnp.zeros_like(v_tp1[-1]), (r_t, v_tp1, end_t), reverse=True)[1]


def short_horizon_return(
    r_t: Array, v_tp1: Array, done_t: Array, valid_t: Array | None = None, *, discount: float
) -> Array:
    """The objective of first-order agents: the discounted rewards of each segment plus the value at its end.

    The discount restarts with each segment.

    Args:
      r_t: rewards, shape (T,).
      v_tp1: value of the state that step t leads to, before any reset; 0 if it is terminal, shape (T,).
      done_t: whether the step ended an episode, shape (T,).
      valid_t: whether the step succeeded, shape (T,); None: all did. A failed step is masked. The segment before it
        ends with the value of the state that the failed step started from.
      discount: gamma [-].

    Returns:
      The sum over all segments, shape (). Gradient: exact.
    Source: Xu et al. 2022, SHAC, eq. 5.
    """
    valid_t = jnp.ones_like(done_t) if valid_t is None else valid_t
    end_t = segment_ends(done_t, valid_t)

    def forward(weight: Array, inputs: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        r, v, end, valid = inputs
        # Xu et al., eq. 5: gamma^k r_k, and gamma^h V at the end of a segment
        gained = weight * (r + jnp.where(end, discount * v, 0.0))
        return jnp.where(end, 1.0, weight * discount), jnp.where(valid, gained, 0.0)

    return jax.lax.scan(forward, jnp.ones_like(r_t[0]), (r_t, v_tp1, end_t, valid_t))[1].sum()
