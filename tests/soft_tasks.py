"""Soft tasks with one compiled step each, and what several tests of them need."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import rewax
from rewax.envs.kit.soft_task import SoftPhysics


@functools.cache
def make(name, scale="small"):
    return rewax.make(name, scale=scale)


@functools.cache
def step(name):
    """One control step at scale small."""
    return jax.jit(make(name).step)


@functools.cache
def start(name):
    return jax.jit(make(name).reset)(jax.random.key(0))


def run(name, state, action, num):
    """States after each of so many equal actions."""
    states = []
    for _ in range(num):
        state = step(name)(state, jnp.broadcast_to(jnp.asarray(action, jnp.float32), make(name).action_spec.shape))
        states.append(state)
    return states


def physics(env, x, *, v=None, **changes):
    """A state with these points."""
    soft = env.at_rest(jnp.asarray(x, jnp.result_type(float)))
    soft = soft if v is None else soft.replace(v=jnp.asarray(v, soft.v.dtype))
    parts = {"joint_q": env.joint_start, "joint_qd": 0 * env.joint_start, "action": jnp.zeros(env.num_actions)}
    return SoftPhysics(soft=soft, **{**parts, **changes})


def assert_reset_noise(env, num=256):
    """Positions of many resets are the rest's, shifted and stretched within the bounds, which are reached."""
    x = np.asarray(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num)).physics.soft.x, np.float64)
    rest, noise = np.asarray(env.rest_positions, np.float64), env.noise
    a, b = rest[np.argmin(rest[:, 0])], rest[np.argmax(rest[:, 0])]
    stretch = (x[:, np.argmax(rest[:, 0]), 0] - x[:, np.argmin(rest[:, 0]), 0]) / (b - a)[0]
    shift = x / stretch[:, None, None] - rest
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=1e-5)
    for values, low, high in [
        *zip(shift[:, 0].T, np.asarray(noise.shift_lower), np.asarray(noise.shift_upper), strict=True),
        (stretch - 1.0, -float(noise.stretch), float(noise.stretch)),
    ]:
        assert low - 1e-5 <= values.min() and values.max() <= high + 1e-5
        assert np.ptp(values) >= 0.95 * (high - low) - 1e-5
        np.testing.assert_allclose(values.mean(), 0.5 * (low + high), atol=0.1 * (high - low) + 1e-5)
    return shift, stretch


def difference_errors(env, *, num_steps, scale=0.3, directions=2, h=1e-6, seed=0, task=None):
    """Errors of the gradient of the return by actions: against forward mode and differences, along random directions.

    ``task`` replaces what the task keeps at the start. Errors are relative, shape (directions, 2).
    """
    key = jax.random.key(seed)
    actions = scale * jax.random.uniform(key, (num_steps, *env.action_spec.shape), minval=-1.0, maxval=1.0)

    first = env.reset(key)
    if task is not None:
        first = first.replace(physics=first.physics.replace(task=jnp.asarray(task, first.physics.soft.x.dtype)))

    @jax.jit
    def total(actions):
        def one(state, action):
            state = env.step(state, action)
            return state, state.reward

        return jax.lax.scan(one, first, actions)[1].sum()

    slope, errors = jax.jit(jax.grad(total))(actions), []
    for k in range(directions):
        along = jax.random.normal(jax.random.fold_in(key, k), actions.shape)
        forward = jax.jit(lambda a, d: jax.jvp(total, (a,), (d,))[1])(actions, along)
        difference = (total(actions + h * along) - total(actions - h * along)) / (2 * h)
        found = jnp.vdot(slope, along)
        errors.append((abs(found - forward) / abs(found), abs(found - difference) / abs(found)))
    return np.asarray(errors, np.float64)
