"""Compiler of traced programs to C++ on a CPU (docs/lowering.md)."""

from rewax.lowering.fusion import compute_once, materialize
from rewax.lowering.kernels import pointwise
from rewax.lowering.machine import interpreted
from rewax.lowering.portability import portable
from rewax.lowering.recompute import recomputed
from rewax.lowering.report import LoweringWarning, recorded
from rewax.lowering.splitting import split_vector
from rewax.lowering.structural import structural_zeros

__all__ = [
    "LoweringWarning", "compute_once", "interpreted", "materialize", "pointwise", "portable", "recomputed", "recorded",
    "split_vector", "structural_zeros",
]  # fmt: skip
