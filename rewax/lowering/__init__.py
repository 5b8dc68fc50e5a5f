"""The compiler under the physics: traced programs that run in C++ on a CPU (docs/lowering.md)."""

from rewax.lowering.fusion import compute_once, materialize
from rewax.lowering.kernels import pointwise
from rewax.lowering.machine import interpreted
from rewax.lowering.recompute import recomputed
from rewax.lowering.splitting import split_vector

__all__ = ["compute_once", "interpreted", "materialize", "pointwise", "recomputed", "split_vector"]
