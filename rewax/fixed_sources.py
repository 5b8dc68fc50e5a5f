"""The C++ programs of rewax, the same on every machine, so that a wheel can bring their libraries."""

import numpy as np

from rewax.lowering import machine, splitting
from rewax.lowering.build import Source
from rewax.physics.mpm import transfer_cpp


def fixed_sources() -> tuple[Source, ...]:
    """Every program: transfers, the machine in both precisions, and what cuts vectors into arrays."""
    machines = (machine.machine(np.dtype(dtype)).source for dtype in ("float32", "float64"))
    return (transfer_cpp.SOURCE, splitting._SOURCE, *machines)
