"""Names for arrays, so that signatures say what is meant."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import jax

Array: TypeAlias = jax.Array
Scalar: TypeAlias = jax.Array | float
"""A number: shape ()."""
Key: TypeAlias = jax.Array
"""A typed PRNG key (``jax.random.key``), shape ()."""
Observation: TypeAlias = Mapping[str, jax.Array]
"""Named observation arrays of one environment."""
PyTree: TypeAlias = Any
