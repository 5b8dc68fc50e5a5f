"""Regression of critics onto targets, such as TD(lambda) returns."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

from rewax.agents.base import Metrics
from rewax.agents.config import Division
from rewax.agents.devices import mean_over_devices, num_shards, sharded
from rewax.agents.optimizers import Packing, apply, finite_or_zero
from rewax.agents.rollout import masked
from rewax.envs.base import ArraySpec
from rewax.types import Array, Observation, PyTree

Values = Callable[[PyTree, Observation], Array]
"""``(params, obs) -> values`` of all critics, shape (n, num_critics), for observations with one leading axis."""
ValueLoss = Callable[[Array, Array], Array]
"""``(values, targets) -> losses``, one loss per value; shapes (n, num_critics), (n, 1) and (n, num_critics)."""
_CACHED_POINTS = 4096
"""Number of observed points with activations that fit the cache of a CPU. With 64,000, a critic's gradient takes twice
as long per point."""


def square_error(values: Array, targets: Array) -> Array:
    """(values - targets)^2."""
    return (values - targets) ** 2


def fit_values(
    values: Values,
    params: PyTree,
    opt_state: PyTree,
    optimizer: optax.GradientTransformation,
    obs: Observation,
    targets: Array,
    valid: Array,
    *,
    passes: int,
    minibatches: int,
    chunk: int,
    divide: Division = "time",
    loss: ValueLoss = square_error,
) -> tuple[PyTree, PyTree, Metrics]:
    """Fits the critics with several passes over minibatches.

    Args:
      values: function that evaluates all critics.
      params, opt_state, optimizer: the critics' parameters and their optimizer.
      obs: normalised observations, leading axes (num_envs, horizon).
      targets: targets, shape (num_envs, horizon). Gradient: none.
      valid: mask of the samples to use, shape (num_envs, horizon), bool. Masked samples may be NaN.
      passes: passes over all data.
      minibatches: minibatches per pass; a divisor of the number of samples.
      chunk: samples differentiated at a time; a divisor of the minibatch size. It changes the update by rounding only.
      divide: with ``time`` a minibatch has contiguous steps of all environments; with ``environments`` it has all steps
        of every ``minibatches``-th environment, and ``minibatches`` must divide num_envs.
      loss: loss of each value. The mean over samples and critics is minimised.

    Returns:
      Parameters, optimizer state, and the metrics ``critic_loss`` (of the last pass) and ``critic_grad_norm``.
    """
    obs, targets = masked((dict(obs), targets), valid)
    fit = functools.partial(
        _fit, objective=functools.partial(_objective, values=values, loss=loss), optimizer=optimizer, passes=passes,
        minibatches=minibatches, chunk=chunk, divide=divide,
    )  # fmt: skip
    given = (params, opt_state, obs, targets, valid)
    divided = targets.shape[1] if divide == "time" else targets.shape[0] // num_shards()
    if divided % minibatches:  # a minibatch would differ between devices: fit unsharded
        return fit(*given)
    return sharded(fit, given, (False, False, True, True, True), same=True)


def _objective(
    params: PyTree, obs: Observation, target: Array, weight: Array, *, values: Values, loss: ValueLoss
) -> Array:
    return jnp.mean(weight[:, None] * loss(values(params, obs), target[:, None]))


def _fit(
    params: PyTree,
    opt_state: PyTree,
    obs: Observation,
    targets: Array,
    valid: Array,
    *,
    objective: Callable[..., Array],
    optimizer: optax.GradientTransformation,
    passes: int,
    minibatches: int,
    chunk: int,
    divide: Division,
) -> tuple[PyTree, PyTree, Metrics]:
    chunk = math.gcd(chunk, targets.size // minibatches)  # on each device's shard

    def parts(a: Array) -> Array:
        if divide == "environments":
            a = a.reshape(-1, minibatches, *a.shape[1:])  # every n-th, on any number of devices the same
        rest = a.shape[2:] if divide == "time" else a.shape[3:]
        return jnp.swapaxes(a, 0, 1).reshape(minibatches, -1, chunk, *rest)

    weight = parts(valid.astype(targets.dtype))
    share = mean_over_devices(weight.mean(axis=(1, 2), keepdims=True))
    weight = weight / jnp.where(share > 0, share, 1.0)  # exactly 1 if no sample is masked
    batches = (jax.tree.map(parts, obs), parts(targets), weight)
    packing = Packing(params)

    def update(carry: tuple[PyTree, PyTree], batch: tuple[Observation, Array, Array]):
        params = packing.unpack(carry[0])
        value, grad = mean_over_devices(
            mean_over_chunks(lambda *chunk: packing.pack(jax.value_and_grad(objective)(params, *chunk)), batch)
        )
        grad = finite_or_zero(grad)
        return apply(optimizer, grad, carry[1], carry[0]), (value, optax.tree.norm(grad))

    def one_pass(carry: tuple[PyTree, PyTree], _: None):
        return jax.lax.scan(update, carry, batches)

    end, (losses, norms) = jax.lax.scan(one_pass, packing.pack((params, opt_state)), None, length=passes)
    params, opt_state = packing.unpack(end)
    return params, opt_state, {"critic_loss": losses[-1].mean(), "critic_grad_norm": norms.mean()}


def mean_over_chunks(function: Callable[..., PyTree], chunks: tuple[PyTree, ...]) -> PyTree:
    """Mean of ``function(*chunk)`` over the leading axis of all arrays in ``chunks``, computed sequentially."""
    first = jax.tree.map(lambda a: a[0], chunks)
    count = len(jax.tree.leaves(chunks)[0])

    def add(total: PyTree, chunk: tuple[PyTree, ...]) -> tuple[PyTree, None]:
        return jax.tree.map(jnp.add, total, function(*chunk)), None

    if count == 1:
        return function(*first)
    zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(function, *first))
    return jax.tree.map(lambda a: a / count, jax.lax.scan(add, zeros, chunks)[0])


def chunk_size(minibatch: int, observation_spec: dict[str, ArraySpec]) -> int:
    """Number of samples to differentiate at a time: all on an accelerator, as many as fit the cache on a CPU."""
    if jax.default_backend() != "cpu":
        return minibatch
    points = max((spec.shape[0] for spec in observation_spec.values() if len(spec.shape) == 2), default=1)
    return max(n for n in range(1, minibatch + 1) if minibatch % n == 0 and (n == 1 or n * points <= _CACHED_POINTS))
