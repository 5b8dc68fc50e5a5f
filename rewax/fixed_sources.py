"""The C++ programs of rewax, the same on every machine, so that a wheel can bring their libraries."""

import threading

import numpy as np

from rewax.lowering import build, machine, splitting
from rewax.lowering.build import Source
from rewax.physics.mpm import transfer_cpp


def fixed_sources() -> tuple[Source, ...]:
    """Every program: transfers, the machine in both precisions, and what cuts vectors into arrays."""
    machines = (machine.machine(np.dtype(dtype)).source for dtype in ("float32", "float64"))
    return (transfer_cpp.SOURCE, splitting._SOURCE, *machines)


def build_ahead(*, transfers: bool = True) -> threading.Thread:
    """Load the programs of float32 in a thread, building what neither came with rewax nor was built before.

    The compiler is a process of its own: it works while Python imports and traces. Whoever needs a program before it is
    there waits for it (``build.load``).

    Args:
      transfers: also those between particles and grid.
    """
    sources = [machine.machine(np.dtype("float32")).source, *[transfer_cpp.SOURCE] * transfers, splitting._SOURCE]

    def run() -> None:
        for source in sources:
            build.load(source)

    thread = threading.Thread(target=run, name="rewax-build", daemon=True)
    thread.start()
    return thread
