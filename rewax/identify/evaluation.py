"""Cost, gradient and Gauss-Newton matrix of a fit at several starts: the one compiled program of ``identify``."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.envs.leaves import EnvLeaves
from rewax.identify.losses import huber, huber_weight
from rewax.identify.simulate import Data, simulated_frames
from rewax.identify.surface import surface_offsets, surface_residuals
from rewax.identify.unknowns import Space
from rewax.status import FATAL
from rewax.types import Array

Residuals = Callable[[Array, Array, Array, Array], Array]
"""``(particles, cloud, mask, offsets) -> residuals`` of one frame [m], (num_points,); ``offsets``: of the surface."""
REST = ".rest_positions"
"""End of the name of the array of rest positions among the leaves of an environment, which may be wrapped."""
HUBER = 2.0
"""Residuals beyond so many standard deviations count linearly."""


class Evaluation(NamedTuple):
    """At S starts, with k unknowns and T frames; arrays of JAX or NumPy. Residuals are in standard deviations."""

    cost: Any
    """Cost of the data alone, without the prior, shape (S,)."""
    gradient: Any
    """Shape (S, k)."""
    hessian: Any
    """Gauss-Newton Hessian, shape (S, k, k)."""
    scores: Any
    """The gradient by region, shape (S, num_regions, k)."""
    spread: Any
    """Robust standard deviation of the residuals of the weighted frames [m], shape (S,)."""
    by_frame: Any
    """Root mean square of the residuals of each frame, clipped at twice the Huber bound [m], shape (S, T)."""
    status: Any
    """Bits, int32, shape (S,)."""
    ok: Any
    """Whether the simulation is valid and finite, shape (S,), bool."""


def to_surface(width: Array) -> Residuals:
    """Residuals of seen points to the surface of the particles; the first frame fixes its offsets."""

    def residuals(particles: Array, cloud: Array, mask: Array, offsets: Array) -> Array:
        del mask
        return surface_residuals(particles, cloud, width, offsets)

    return residuals


@functools.partial(jax.jit, static_argnames=("space", "residuals", "num_regions"))
def evaluate(
    latents: Array,
    placements: Array | None,
    leaves: EnvLeaves,
    data: Data,
    weights: Array,
    deviation: Array,
    *,
    space: Space,
    residuals: Residuals | None,
    num_regions: int,
) -> Evaluation:
    """The fit at several latent points.

    Args:
      latents: shape (S, k).
      placements: rest positions of each start [m], shape (S, num_particles, 3); None: those of the environment.
      leaves: parameters of the environment; new values need no compilation.
      data: of the record.
      weights: of the frames, shape (T,); 0 leaves a frame out.
      deviation: standard deviation of a residual [m], shape ().
      space: the unknowns.
      residuals: of a frame; None: distances to the surface of the particles.
      num_regions: number of regions, ``data.clusters`` are below it.
    """

    def one(start: tuple[Array, Array | None]) -> Evaluation:
        latent, placement = start
        moved = {} if placement is None else {name: placement for name in leaves.arrays if name.endswith(REST)}
        env = leaves.replace(arrays={**leaves.arrays, **moved}).build()

        def predicted(latent: Array) -> tuple[Array, Array]:
            frames, status = simulated_frames(env, space, latent, data)
            offsets = surface_offsets(frames[0], data.clouds[0], data.mask[0], data.width)
            chosen = to_surface(data.width) if residuals is None else residuals

            def of_frame(frame: tuple[Array, Array, Array]) -> Array:
                return chosen(*frame, offsets)

            return jax.lax.map(of_frame, (frames, data.clouds, data.mask)), status

        basis = jnp.eye(latent.shape[0], dtype=latent.dtype)
        r, columns, status = jax.vmap(
            lambda tangent: _jvp_with_status(predicted, latent, tangent), out_axes=(None, 0, None)
        )(basis)
        return _summary(r, jnp.moveaxis(columns, 0, -1), status, data, weights, deviation, num_regions)

    return jax.vmap(one)((latents, placements))


def _jvp_with_status(predicted: Any, latent: Array, tangent: Array) -> tuple[Array, Array, Array]:
    r, column, status = jax.jvp(predicted, (latent,), (tangent,), has_aux=True)
    return r, column, status


def _summary(
    r: Array, jacobian: Array, status: Array, data: Data, weights: Array, deviation: Array, num_regions: int
) -> Evaluation:
    """Sums over frames and points; ``r`` has shape (T, N), ``jacobian`` (T, N, k)."""
    finite = jnp.isfinite(r).all() & jnp.isfinite(jacobian).all()
    weight = data.mask * weights[:, None]
    scaled = jnp.where(data.mask, r / deviation, 0.0)
    slope = jnp.where(data.mask[..., None], jacobian / deviation, 0.0)
    robust = weight * huber_weight(scaled, HUBER)
    score = (robust * scaled)[..., None] * slope
    used = (weight > 0).reshape(-1)
    magnitude = jnp.where(used, jnp.abs(r).reshape(-1), jnp.nan)
    clipped = jnp.where(data.mask, jnp.minimum(jnp.abs(scaled), 2.0 * HUBER) * deviation, 0.0)
    return Evaluation(
        cost=(weight * huber(scaled, HUBER)).sum(),
        gradient=score.sum((0, 1)),
        hessian=jnp.einsum("tn,tni,tnj->ij", robust, slope, slope),
        scores=jax.ops.segment_sum(score.reshape(-1, score.shape[-1]), data.clusters.reshape(-1), num_regions),
        spread=1.4826 * jnp.nanmedian(magnitude),
        by_frame=jnp.sqrt((clipped**2).sum(1) / jnp.maximum(data.mask.sum(1), 1)),
        status=status,
        ok=finite & ((status & FATAL) == 0),
    )


__all__ = ["HUBER", "REST", "Evaluation", "Residuals", "evaluate", "to_surface"]
