"""Shared by the cases of cloth and ropes: static equilibria, linear deflections, vibrations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import thin

NOTHING, DOWN = (0.0, 0.0, 0.0), (0.0, -9.81, 0.0)
ADVANCE = jax.jit(thin.step, static_argnames="store_every")


def settled(x: np.ndarray, steps: int, **given: Any) -> np.ndarray:
    """Positions at rest of a body released at x, by implicit steps of 50 ms with drag."""
    stepper = thin.Implicit(tolerance=1e-8, newton_iterations=50, cg_tolerance=1e-4)
    scene = thin.make_scene(**{"dt": 0.05, "drag": 4.0, "gravity": DOWN, "stepper": stepper} | given)
    state = thin.initial_state(x)
    for _ in range(2):  # the status is that of the second half
        state = ADVANCE(scene, state, thin.static_poses(steps // 2, dtype=float), store_every=None)
    if int(thin.check_status(scene, state)) or float(jnp.abs(state.v).max()) > 1e-5:
        raise RuntimeError(f"not at rest: speed {float(jnp.abs(state.v).max()):.2g} m/s, error {state.error}")
    return np.asarray(state.x)


def deflections(scene: thin.ThinScene, x: Any, held: np.ndarray) -> np.ndarray:
    """Heights by which free vertices sink under a load of mass times 1 m/s^2, by linear theory."""
    free = np.flatnonzero(~held)
    matrix = np.asarray(stiffness(scene, jnp.asarray(x)))[np.ix_(free, free)]
    moved = np.zeros(len(held))
    moved[free] = np.linalg.solve(matrix, np.asarray(scene.mass)[free])
    return moved


@jax.jit
def stiffness(scene: thin.ThinScene, x: jax.Array) -> jax.Array:
    """Second derivative of the energy with respect to the heights of vertices, shape (num_vertices, num_vertices)."""

    def lifted(y: jax.Array) -> jax.Array:
        return -thin.internal_force(scene, thin.initial_state(x.at[:, 1].set(y)))[:, 1]

    return jax.jacfwd(lifted)(x[:, 1])


def amplitudes(
    scene: thin.ThinScene, state: thin.ThinState, shape: np.ndarray, every: int, num_samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and the share of a mode in the heights of vertices, every ``every`` substeps."""
    weights = jnp.asarray(shape) * scene.mass
    poses = thin.static_poses(every, dtype=float)

    @jax.jit
    def run(state: thin.ThinState) -> jax.Array:
        def sample(state: thin.ThinState, _: None) -> tuple[thin.ThinState, jax.Array]:
            state = thin.step(scene, state, poses, store_every=None)
            return state, jnp.sum(weights * state.x[:, 1]) / jnp.sum(weights * shape)

        return jax.lax.scan(sample, state, None, num_samples)[1]

    return scene.dt * every * np.arange(1, num_samples + 1), np.asarray(run(state))


def period(times: np.ndarray, values: np.ndarray) -> float:
    """Twice the time between the first two changes of sign."""
    at = np.flatnonzero(values[1:] * values[:-1] < 0)[:2]
    crossings = times[at] + (times[1] - times[0]) * values[at] / (values[at] - values[at + 1])
    return float(2 * (crossings[1] - crossings[0]))
