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

from rewax.envs.memory import MEMORY
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
    """Linear -> LayerNorm -> activation. LayerNorm's epsilon is flax's 1e-6; SAPO's code has PyTorch's 1e-5."""

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


class PictureEncoder(nn.Module):
    """Features of a picture, (height, width, channels): a convolutional network.

    The first layer has 4 x 4 pixels at a stride of 4, the others 3 x 3 at a stride of 2, zeros beyond the border; each
    is followed by LayerNorm over its channels. One more layer takes what is left.

    Each convolution is a matrix product of patches. ``flax.linen.Conv`` computes the same, but its gradient is slow on
    a CPU under ``vmap``.
    """

    widths: Sequence[int]
    features: int
    activation: Activation
    gain: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for i, width in enumerate(self.widths):
            size, stride = (4, 4) if i == 0 else (3, 2)
            x = Layer(width, self.activation, self.gain)(patches(x, size, stride))
        return Layer(self.features, self.activation, self.gain)(x.reshape(-1))


def patches(x: Array, size: int, stride: int) -> Array:
    """Square patches of a picture, side by side as channels.

    Args:
      x: shape (height, width, channels).
      size: edge of a patch [pixels].
      stride: between patches [pixels].

    Returns:
      Shape (ceil(height / stride), ceil(width / stride), size * size * channels); zeros beyond the border.
    """
    height, width, _ = x.shape
    rows, columns = -(-height // stride), -(-width // stride)
    before = (size - stride + 1) // 2
    after = [max((n - 1) * stride + size - before - edge, 0) for n, edge in ((rows, height), (columns, width))]
    x = jnp.pad(x, ((before, after[0]), (before, after[1]), (0, 0)))
    parts = [
        x[i : i + stride * (rows - 1) + 1 : stride, j : j + stride * (columns - 1) + 1 : stride]
        for i in range(size)
        for j in range(size)
    ]
    return jnp.concatenate(parts, axis=-1)


class Encoder(nn.Module):
    """Features of a named observation.

    Point clouds, arrays (num_points, channels), each go through a PointNet: layers per point, mean over the points,
    one more layer. Pictures, arrays (height, width, channels), each go through a ``PictureEncoder``. Vectors are
    concatenated in the order of their names and go through one layer, or as they are with ``vector_features`` 0.

    ``observe`` names the observations that are seen; empty: all.

    Source: the 3D Diffusion Policy encoder as used by SAPO, with mean instead of max pooling; pictures are an addition.
    """

    point_widths: Sequence[int]
    point_features: int
    vector_features: int
    activation: Activation
    gain: float
    picture_widths: Sequence[int] = ()
    picture_features: int = 64
    observe: Sequence[str] = ()

    @nn.compact
    def __call__(self, obs: Observation) -> Array:
        seen = {name: obs[name] for name in sorted(self.observe or obs)}
        features = []
        for name, a in seen.items():
            if a.ndim == 2:
                x = MLP(self.point_widths, self.activation, self.gain, name=f"points_{name}")(a)
                features.append(
                    Layer(self.point_features, self.activation, self.gain, name=f"pooled_{name}")(x.mean(axis=0))
                )
            elif a.ndim == 3:
                sizes = (self.picture_widths, self.picture_features)
                features.append(PictureEncoder(*sizes, self.activation, self.gain, name=f"picture_{name}")(a))
        vectors = [a.reshape(-1) for a in seen.values() if a.ndim not in (2, 3)]
        if vectors:
            joined = jnp.concatenate(vectors)
            if self.vector_features:
                joined = Layer(self.vector_features, self.activation, self.gain, name="vectors")(joined)
            features.append(joined)
        return jnp.concatenate(features)


class GRU(nn.Module):
    """A gated recurrent unit: the memory after an input, shape (size,).

        keep = sigmoid(W_k x + U_k m),  reset = sigmoid(W_r x + U_r m),  new = tanh(W_n x + reset * U_n m)
        m' = keep * m + (1 - keep) * new,   each sum with a bias

    Every component stays in (-1, 1). Memories of 0 are where an episode begins. The bias of ``keep`` begins as 1, so an
    untrained memory fades over some steps.

    Source: Cho et al. 2014, with the reset gate after the product, as in cuDNN. The bias is an addition.
    """

    size: int
    gain: float

    @nn.compact
    def __call__(self, memory: Array, x: Array) -> Array:
        def three(gain: float) -> nn.initializers.Initializer:
            def init(key: Key, shape: Sequence[int], dtype: DTypeLike = jnp.float32, *_: object) -> Array:
                one = (shape[0], self.size)
                return jnp.concatenate([orthogonal(gain)(k, one, dtype) for k in jax.random.split(key, 3)], axis=1)

            return init

        def bias(_: Key, shape: Sequence[int], dtype: DTypeLike = jnp.float32) -> Array:
            return jnp.zeros(shape, dtype).at[: self.size].set(1.0)

        given = nn.Dense(3 * self.size, kernel_init=three(self.gain), bias_init=bias, name="input")(x)
        old = nn.Dense(3 * self.size, kernel_init=three(1.0), name="recurrent")(memory)
        (keep, reset, new), (keep_old, reset_old, new_old) = jnp.split(given, 3), jnp.split(old, 3)
        kept = jax.nn.sigmoid(keep + keep_old)
        new = jnp.tanh(new + jax.nn.sigmoid(reset + reset_old) * new_old)
        return kept * memory + (1.0 - kept) * new


class GaussianActor(nn.Module):
    """Observation -> mean and clamped log standard deviation of the action before its tanh.

    ``head_gain`` is the last layer's gain; None: ``gain``. The standard deviation depends on the observation; with
    ``state_dependent_std=False`` it is a parameter.

    With ``memory`` > 0, its size, a ``GRU`` takes the encoder's features and the observation ``memory``. The layers see
    the features and the new memory, which is the third result.
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
    memory: int = 0

    @nn.compact
    def __call__(self, obs: Observation) -> tuple[Array, ...]:
        if self.memory:
            features = self.encoder({name: value for name, value in obs.items() if name != MEMORY})
            memory = (GRU(self.memory, self.gain, name="memory")(obs[MEMORY], features),)
            features = jnp.concatenate([features, *memory])
        else:
            features, memory = self.encoder(obs), ()
        x = MLP(self.widths, self.activation, self.gain)(features)
        init = orthogonal(self.gain if self.head_gain is None else self.head_gain)
        mean = nn.Dense(self.action_size, kernel_init=init, name="mean")(x)
        bias = nn.initializers.constant(self.initial_log_std)
        if self.state_dependent_std:
            log_std = nn.Dense(self.action_size, kernel_init=init, bias_init=bias, name="log_std")(x)
        else:
            log_std = self.param("log_std", bias, (self.action_size,))
        return mean, jnp.clip(log_std, *self.log_std_range), *memory


class Critics(nn.Module):
    """Observation -> values of several independent heads on one shared encoder, shape (num_critics,).

    With an action, action values: the action is concatenated to the encoder's features. ``head_gain``: see
    ``GaussianActor``. With ``num_outputs`` > 1 each head has so many outputs, and the shape is
    (num_critics, num_outputs).
    """

    encoder: Encoder
    widths: Sequence[int]
    num_critics: int
    activation: Activation
    gain: float
    head_gain: float | None = None
    num_outputs: int = 1

    @nn.compact
    def __call__(self, obs: Observation, action: Array | None = None) -> Array:
        features = self.encoder(obs)
        if action is not None:
            features = jnp.concatenate([features, action])
        init = orthogonal(self.gain if self.head_gain is None else self.head_gain)
        values = [
            nn.Dense(self.num_outputs, kernel_init=init, name=f"value_{i}")(
                MLP(self.widths, self.activation, self.gain, name=f"mlp_{i}")(features)
            )
            for i in range(self.num_critics)
        ]
        return jnp.concatenate(values) if self.num_outputs == 1 else jnp.stack(values)


ACTIVATIONS: Mapping[str, Activation] = {"silu": jax.nn.silu, "elu": jax.nn.elu, "relu": jax.nn.relu, "tanh": jnp.tanh}
