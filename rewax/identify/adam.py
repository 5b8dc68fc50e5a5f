"""Adam on the unknowns, in reverse mode: for many unknowns, or for a loss that is no sum of squares."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomize import Draw
from rewax.identify.losses import over_time
from rewax.identify.record_checks import check_against, check_frame_weights, check_record
from rewax.identify.records import Record
from rewax.identify.simulate import Data, data_of, points_of, simulated_frames, without_reset_noise
from rewax.identify.unknowns import Space, is_stable, space_of, stable_bounds
from rewax.status import FATAL, describe
from rewax.types import Array

Loss = Callable[[Array, Array, Array], Array]
"""``(particles, cloud, mask) -> loss`` of one frame, shape (); those of ``rewax.identify`` and any of your own."""


class Minimum(NamedTuple):
    """Result of ``minimize``."""

    values: dict[str, float]
    """By the first name of each unknown."""
    loss: float
    latent: np.ndarray
    """Shape (k,)."""
    losses: np.ndarray
    """Losses of the accepted points, shape (iterations,)."""
    failed: int
    """Simulations that failed; each halved the step."""
    remarks: list[str]
    """Sentences about unknowns that the stable substep limits."""


def minimize(
    env: Any,
    record: Record,
    unknowns: Mapping[Any, Draw],
    loss: Loss,
    *,
    iterations: int = 60,
    learning_rate: float = 0.1,
    frame_weights: np.ndarray | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Minimum:
    """Minimise a loss of the user by Adam, from the median of the priors, within their bounds and the stable ones.

    A step that leads to a failed simulation is taken back to half its length, as is one that is known to be unstable.

    Args:
      env, record, unknowns, frame_weights, seed, progress: as of ``identify``.
      loss: of one frame. Give the same function again to use its compiled program again.
      iterations: steps, 1 or more.
      learning_rate: in standard deviations of the priors, above 0.

    Raises:
      ValueError: as ``identify``; or an option is illegal, or the median of the priors has no valid simulation, or no
        finite loss.
    """
    if iterations < 1:
        raise ValueError(f"iterations is {iterations}: give at least 1")
    if not 0.0 < learning_rate < np.inf:
        raise ValueError(f"learning_rate is {learning_rate}: give standard deviations of the priors, above 0")
    check_record(record)
    check_frame_weights(frame_weights, record.num_frames)
    env = without_reset_noise(env)
    check_against(record, env, np.asarray(points_of(env, jax.jit(env.reset)(jax.random.key(seed)).physics)))
    space = space_of(unknowns, env)
    low, high, remarks = stable_bounds(space, (env,))
    leaves, data = EnvLeaves.of(env), data_of(record, 1.0, 1, seed)
    weights = jnp.asarray(np.ones(record.num_frames) if frame_weights is None else frame_weights, jnp.float32)
    optimizer = optax.adam(learning_rate)
    latent = np.clip(np.zeros(len(space.draws)), low, high)
    state = optimizer.init(jnp.asarray(latent, jnp.float32))
    best, best_loss, accepted, losses, failed = latent, np.inf, latent, [], 0
    for iteration in range(iterations):
        value, grad, status = _value_and_grad(jnp.asarray(latent, jnp.float32), leaves, data, weights, space, loss)
        grad = np.asarray(grad, float)
        if int(status) & FATAL or not (np.isfinite(value) and np.isfinite(grad).all()):
            if iteration == 0 and not int(status) & FATAL:
                raise ValueError("loss or its gradient is not finite at the median of the priors: give another loss")
            if iteration == 0:
                raise ValueError(f"the median of the priors has status {describe(int(status))}: give softer priors")
            failed += 1
            latent = 0.5 * (latent + accepted)
            continue
        accepted = latent
        losses.append(float(value))
        if value < best_loss:
            best, best_loss = latent, float(value)
        if progress:
            progress(f"iteration {iteration + 1:3d}  loss {float(value):10.4g}")
        updates, state = optimizer.update(jnp.asarray(grad, jnp.float32), state)
        step = np.asarray(updates, float)
        for _ in range(8):
            latent = np.clip(accepted + step, low, high)
            if is_stable(space.place(env, jnp.asarray(latent))):
                break
            step = 0.5 * step
        else:
            latent = accepted
    values = dict(zip(space.labels, (float(v) for v in space.numbers(best)), strict=True))
    return Minimum(values, best_loss, best, np.asarray(losses), failed, remarks)


@functools.partial(jax.jit, static_argnames=("space", "loss"))
def _value_and_grad(
    latent: Array, leaves: EnvLeaves, data: Data, weights: Array, space: Space, loss: Loss
) -> tuple[Array, Array, Array]:
    """Loss, its gradient with respect to latent coordinates, and status bits."""

    def total(latent: Array) -> tuple[Array, Array]:
        frames, status = simulated_frames(leaves.build(), space, latent, data)
        by_frame = jax.lax.map(lambda frame: loss(*frame), (frames, data.clouds, data.mask))
        return over_time(by_frame, weights), status

    (value, status), grad = jax.value_and_grad(total, has_aux=True)(latent)
    return value, grad, status


__all__ = ["Loss", "Minimum", "minimize"]
