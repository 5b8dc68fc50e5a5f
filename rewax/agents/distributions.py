"""Action distributions."""

import distrax
import jax
import jax.numpy as jnp

from rewax import struct
from rewax.types import Array, Key


@struct.dataclass
class TanhNormal:
    """A diagonal normal distribution squashed into (-1, 1) by tanh.

    distrax's own ``Transformed(Normal, Tanh)`` gives NaN for the log probability of a saturated action, because it
    inverts the tanh. Here log probabilities are computed from the value before the tanh.

    Attributes:
      mean: mean of the normal distribution, shape (action_size,).
      log_std: logarithm of its standard deviation, shape (action_size,).
    """

    mean: Array
    log_std: Array

    @property
    def base(self) -> distrax.Normal:
        """The distribution before the tanh."""
        return distrax.Normal(self.mean, jnp.exp(self.log_std))

    def sample_raw(self, key: Key) -> Array:
        """An action before its tanh, shape (action_size,). Gradient: through the sample."""
        return self.base.sample(seed=key)

    def log_prob_raw(self, raw: Array) -> Array:
        """Log probability density of the action tanh(raw), shape (). Gradient: exact, finite everywhere."""
        log_det = 2.0 * (jnp.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))
        return jnp.sum(self.base.log_prob(raw) - log_det)

    def kl_divergence(self, other: "TanhNormal") -> Array:
        """KL(self || other), shape (). Gradient: exact.

        The tanh does not change it: it is that of the two normal distributions.
        """
        return jnp.sum(self.base.kl_divergence(other.base))

    def sample_and_log_prob(self, key: Key) -> tuple[Array, Array]:
        """An action, shape (action_size,), and its log probability density, shape ().

        Gradient: exact with respect to mean and log_std, through the sample (reparameterised).
        """
        raw = self.sample_raw(key)
        return jnp.tanh(raw), self.log_prob_raw(raw)

    def sample(self, key: Key) -> Array:
        """An action, shape (action_size,). Gradient: through the sample."""
        return self.sample_and_log_prob(key)[0]

    def mode(self) -> Array:
        """tanh(mean), shape (action_size,): the median of the distribution, used as the deterministic action."""
        return jnp.tanh(self.mean)
