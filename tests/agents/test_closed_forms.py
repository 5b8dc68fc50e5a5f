"""Algorithms against closed forms: the linear-quadratic regulator, and gradients against zeroth-order estimates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax import struct
from rewax.agents.apg import APGConfig
from rewax.agents.registry import make_agent
from rewax.agents.rollout import rollout
from rewax.agents.sapo import SAPOConfig
from rewax.agents.shac import SHACConfig
from rewax.envs.base import ArraySpec, first_state, next_state
from rewax.envs.wrappers import AutoReset
from rewax.training.evaluation.episodes import make_evaluate

LENGTH = 24
A, B = np.array([[1.0, 0.25], [0.0, 1.0]]), np.array([[0.0], [0.5]])
Q, R = np.diag([1.0, 0.2]), np.array([[0.2]])


@struct.dataclass
class LinearQuadratic:
    """x <- A x + B u from |x| <= 0.5; the reward is -(x' Q x + u' R u) with the state before the step.

    The optimal u stays within its bounds.
    """

    @property
    def observation_spec(self):
        return {"x": ArraySpec((2,))}

    @property
    def action_spec(self):
        return ArraySpec((1,), -1.0, 1.0)

    @property
    def episode_length(self):
        return LENGTH

    def reset(self, key):
        key, draw = jax.random.split(key)
        x = jax.random.uniform(draw, (2,), minval=-0.5, maxval=0.5)
        return first_state(physics=x, obs={"x": x}, metrics={}, key=key)

    def step(self, state, action):
        x, u = state.physics, jnp.clip(action, -1.0, 1.0)
        reward = -(x @ jnp.asarray(Q, x.dtype) @ x + u @ jnp.asarray(R, x.dtype) @ u)
        x = jnp.asarray(A, x.dtype) @ x + jnp.asarray(B, x.dtype) @ u
        return next_state(state, physics=x, obs={"x": x}, reward=reward, metrics={}, episode_length=LENGTH)


ENV = LinearQuadratic()


def riccati():
    """Cost-to-go of the optimal regulator over the whole episode."""
    p = np.zeros((2, 2))
    for _ in range(LENGTH):
        gain = np.linalg.solve(R + B.T @ p @ B, B.T @ p @ A)
        p = Q + A.T @ p @ (A - B @ gain)
    return p


NETWORKS = {
    "actor_widths": (32,),
    "vector_features": 32,
    "activation": "silu",
    "num_envs": 32,
    "final_learning_rate": 1e-5,
}
CRITICS = {"critic_widths": (32,), "critic_passes": 4, "critic_minibatches": 2, "differentiate": "full"}
LEARNERS = {
    "apg": APGConfig(
        **NETWORKS, horizon=0, num_iterations=900, differentiate="full", actor_learning_rate=5e-3, discount=1.0
    ),
    "shac": SHACConfig(
        **NETWORKS, **CRITICS, horizon=12, num_iterations=700, actor_learning_rate=5e-3, stagger_episodes=True,
        target_decay=None, critic_learning_rate=3e-3, initial_log_std=-2.0,
    ),
    "sapo": SAPOConfig(
        **NETWORKS, **CRITICS, horizon=12, num_iterations=700, actor_learning_rate=5e-3, stagger_episodes=True,
        critic_learning_rate=3e-3, initial_log_std=-2.0, initial_temperature=0.0, learn_temperature=False,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(LEARNERS))
def test_within_one_percent_of_the_riccati_optimum(name):
    agent = make_agent(name, ENV, LEARNERS[name])
    state = agent.init(jax.random.key(0))
    for _ in range(LEARNERS[name].num_iterations):
        state, _ = agent.train_step(state)
    key = jax.random.key(1)
    found = make_evaluate(ENV, agent.policy, 256)(state, key, deterministic=True)
    starts = jax.vmap(lambda k: ENV.reset(jax.random.split(k)[0]).physics)(jax.random.split(key, 256))
    best = -np.einsum("ni,ij,nj->n", starts, riccati(), starts)
    ratio = float(found["mean"]) / best.mean()
    assert 1.0 - 1e-6 <= ratio < 1.01, ratio


def test_the_first_order_gradient_points_where_a_zeroth_order_estimate_does():
    """The return is that of a noisy linear policy. The estimate has 1e5 episodes with antithetic perturbations of its gains."""
    gains, deviation, pairs = jnp.array([-0.3, -0.6]), 0.05, 50_000
    env = AutoReset(env=ENV)

    def episode(gains, key):
        reset_key, act_key = jax.random.split(key)
        noisy = lambda obs, key: (gains @ obs["x"][:, None] + 0.05 * jax.random.normal(key, (1,)), {})  # noqa: E731
        _, t = rollout(env, env.reset(reset_key), noisy, act_key, horizon=LENGTH, differentiate="full")
        return t.reward.sum()

    def zeroth(key):
        shift_key, episode_key = jax.random.split(key)
        shift = deviation * jax.random.normal(shift_key, (2,))
        return (episode(gains + shift, episode_key) - episode(gains - shift, episode_key)) * shift / (2 * deviation**2)

    first = jax.jit(jax.vmap(jax.grad(episode), (None, 0)))(gains, jax.random.split(jax.random.key(0), 256)).mean(0)
    estimate = jax.jit(jax.vmap(zeroth))(jax.random.split(jax.random.key(1), pairs)).mean(0)
    cosine = first @ estimate / (jnp.linalg.norm(first) * jnp.linalg.norm(estimate))
    assert cosine > 0.99, (first, estimate)
