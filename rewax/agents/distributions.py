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
    inverts the tanh; here the value before the tanh is at hand whenever a probability is asked for.

    Attributes:
      mean: of the normal distribution, shape (action_size,).
      log_std: logarithm of its standard deviation, shape (action_size,).
    """

    mean: Array
    log_std: Array

    def sample_and_log_prob(self, key: Key) -> tuple[Array, Array]:
        """An action, shape (action_size,), and the log of its probability density, shape ().

        Gradient: exact with respect to mean and log_std, through the sample (reparameterised).
        """
        base = distrax.Normal(self.mean, jnp.exp(self.log_std))
        raw = base.sample(seed=key)
        log_det = 2.0 * (jnp.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))
        return jnp.tanh(raw), jnp.sum(base.log_prob(raw) - log_det)

    def sample(self, key: Key) -> Array:
        """An action, shape (action_size,). Gradient: through the sample."""
        return self.sample_and_log_prob(key)[0]

    def mode(self) -> Array:
        """tanh of the mean, shape (action_size,): the median, by convention the deterministic action."""
        return jnp.tanh(self.mean)
