"""Networks: point-cloud and vector encoders, policy and value heads (flax linen)."""

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.lax import DotDimensionNumbers
from jax.typing import DTypeLike

from rewax.types import Array, Key, Observation

Activation = Callable[[Array], Array]
_NARROW = 4
"""Up to this many input features, a layer sums products instead of calling ``dot_general``."""


def orthogonal(gain: float) -> nn.initializers.Initializer:
    """flax's orthogonal initialiser, one matrix at a time under ``vmap``.

    Several batched QR decompositions in one program can dead-lock the threads of XLA's CPU backend, so
    ``vmap(agent.init)`` has to draw its matrices one after the other.
    """
    initialise = nn.initializers.orthogonal(gain)

    def init(key: Key, shape: Sequence[int], dtype: DTypeLike = jnp.float32, *_: object) -> Array:
        return jax.custom_batching.sequential_vmap(lambda key: initialise(key, shape, dtype))(key)

    return init


def _product(x: Array, matrix: Array, dimension_numbers: DotDimensionNumbers, **options: Any) -> Array:
    """``lax.dot_general`` of a layer, with flax's options. Inputs with few features are summed, which XLA can fuse.

    Without the sum, jax 0.10.1 fails to compile products of many points (num_points, 3) for GPUs.
    """
    if not 0 < x.shape[-1] <= _NARROW:
        return jax.lax.dot_general(x, matrix, dimension_numbers, **options)
    return functools.reduce(operator.add, (x[..., k, None] * matrix[k] for k in range(x.shape[-1])))


class Layer(nn.Module):
    """Linear -> LayerNorm -> activation."""

    width: int
    activation: Activation
    gain: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        x = nn.Dense(self.width, kernel_init=orthogonal(self.gain), dot_general=_product)(x)
        return self.activation(nn.LayerNorm()(x))


class MLP(nn.Module):
    """A stack of ``Layer``."""

    widths: Sequence[int]
    activation: Activation
    gain: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for width in self.widths:
            x = Layer(width, self.activation, self.gain)(x)
        return x


class Encoder(nn.Module):
    """Features of a named observation.

    Each point cloud, an array (num_points, channels), goes through a PointNet: layers per point, mean over the points,
    one more layer. Vectors are concatenated in the order of their names and go through one layer, or through none if
    ``vector_features`` is 0.

    Source: the 3D Diffusion Policy encoder as used by SAPO, with mean instead of max pooling.
    """

    point_widths: Sequence[int]
    point_features: int
    vector_features: int
    activation: Activation
    gain: float

    @nn.compact
    def __call__(self, obs: Observation) -> Array:
        features = []
        for name in sorted(obs):
            if obs[name].ndim == 2:
                x = MLP(self.point_widths, self.activation, self.gain, name=f"points_{name}")(obs[name])
                features.append(
                    Layer(self.point_features, self.activation, self.gain, name=f"pooled_{name}")(x.mean(axis=0))
                )
        vectors = [obs[name].reshape(-1) for name in sorted(obs) if obs[name].ndim != 2]
        if vectors:
            joined = jnp.concatenate(vectors)
            if self.vector_features:
                joined = Layer(self.vector_features, self.activation, self.gain, name="vectors")(joined)
            features.append(joined)
        return jnp.concatenate(features)


class GaussianActor(nn.Module):
    """Observation -> mean and clamped log standard deviation of the action before its tanh.

    ``head_gain`` is the last layer's gain; None: ``gain``. The standard deviation depends on the observation; with
    ``state_dependent_std=False`` it is a parameter.
    """

    encoder: Encoder
    widths: Sequence[int]
    action_size: int
    activation: Activation
    gain: float
    log_std_range: tuple[float, float]
    initial_log_std: float = 0.0
    state_dependent_std: bool = True
    head_gain: float | None = None

    @nn.compact
    def __call__(self, obs: Observation) -> tuple[Array, Array]:
        x = MLP(self.widths, self.activation, self.gain)(self.encoder(obs))
        init = orthogonal(self.gain if self.head_gain is None else self.head_gain)
        mean = nn.Dense(self.action_size, kernel_init=init, name="mean")(x)
        bias = nn.initializers.constant(self.initial_log_std)
        if self.state_dependent_std:
            log_std = nn.Dense(self.action_size, kernel_init=init, bias_init=bias, name="log_std")(x)
        else:
            log_std = self.param("log_std", bias, (self.action_size,))
        return mean, jnp.clip(log_std, *self.log_std_range)


class Critics(nn.Module):
    """Observation -> values of several independent heads on one shared encoder, shape (num_critics,).

    With an action, action values: the action is concatenated to the encoder's features. ``head_gain``: see
    ``GaussianActor``.
    """

    encoder: Encoder
    widths: Sequence[int]
    num_critics: int
    activation: Activation
    gain: float
    head_gain: float | None = None

    @nn.compact
    def __call__(self, obs: Observation, action: Array | None = None) -> Array:
        features = self.encoder(obs)
        if action is not None:
            features = jnp.concatenate([features, action])
        init = orthogonal(self.gain if self.head_gain is None else self.head_gain)
        values = [
            nn.Dense(1, kernel_init=init, name=f"value_{i}")(
                MLP(self.widths, self.activation, self.gain, name=f"mlp_{i}")(features)
            )
            for i in range(self.num_critics)
        ]
        return jnp.concatenate(values)


ACTIVATIONS: Mapping[str, Activation] = {"silu": jax.nn.silu, "elu": jax.nn.elu, "relu": jax.nn.relu, "tanh": jnp.tanh}
