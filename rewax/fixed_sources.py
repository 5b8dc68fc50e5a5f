"""All C++ programs of rewax. They are the same on every machine, so a wheel can hold their libraries."""

import threading

import numpy as np

from rewax.lowering import build, machine
from rewax.lowering.build import Source
from rewax.physics.mpm import transfer_cpp
from rewax.physics.thin import pair_kernels


def fixed_sources() -> tuple[Source, ...]:
    """All programs: transfers (P2G and G2P), pairs of self-contact, and the machine in both precisions."""
    machines = (machine.machine(np.dtype(dtype)).source for dtype in ("float32", "float64"))
    return (transfer_cpp.SOURCE, pair_kernels.SOURCE, *machines)


def build_ahead(*, transfers: bool = True) -> threading.Thread:
    """Loads the float32 programs in a thread, and builds those that are neither shipped nor cached.

    The compiler is a separate process, so it works while Python imports and traces. ``build.load`` waits for a program
    that is being built.

    Args:
      transfers: whether to load the transfers between particles and grid.
    """
    sources = [machine.machine(np.dtype("float32")).source, *[transfer_cpp.SOURCE] * transfers]

    def run() -> None:
        for source in sources:
            build.load(source)

    thread = threading.Thread(target=run, name="rewax-build", daemon=True)
    thread.start()
    return thread
