"""Type aliases of arrays for signatures."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import jax

Array: TypeAlias = jax.Array
Scalar: TypeAlias = jax.Array | float
"""A number: shape ()."""
Vector: TypeAlias = Any
"""An array in a field of a ``struct.dataclass``; constructors also accept tuples and NumPy arrays of numbers."""
Key: TypeAlias = jax.Array
"""A typed PRNG key (``jax.random.key``), shape ()."""
Observation: TypeAlias = Mapping[str, jax.Array]
"""Named observation arrays of one environment."""
PyTree: TypeAlias = Any
