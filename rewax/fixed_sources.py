"""The C++ programs that are the same on every machine, so that a wheel can bring their libraries."""

import numpy as np

from rewax.lowering import kernels, machine, splitting
from rewax.lowering.build import Source
from rewax.physics.mpm import transfer_native


def fixed_sources() -> tuple[Source, ...]:
    """Every program but the generated kernels, whose text depends on the scene."""
    machines = (machine.machine(np.dtype(dtype)).source for dtype in ("float32", "float64"))
    return (transfer_native.SOURCE, kernels._CALLER, splitting._SOURCE, *machines)
