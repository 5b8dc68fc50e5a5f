"""The scene of ``thin_speed.py`` in NumPy, for opponents that lack JAX, and the protocol of its workers.

A sheet of square cells falls on a fixed sphere. A worker answers ``OPERATION NUM_SUBSTEPS`` from standard input with a
line of JSON: seconds, processor seconds, the mean height afterwards, and for gradients its derivative by the initial
velocity, summed over vertices.
"""

import json
import sys
import time
import traceback
from typing import Any

import numpy as np

CELLS = {1000: (20, 25), 10000: (50, 100)}
LENGTH = {1000: 0.5, 10000: 1.0}
"""Cells along x and z, and length along z [m], by number of triangles."""
DT = 1e-4
DENSITY = 0.2
"""Mass per area [kg/m^2]."""
STIFFNESS = 20.0
"""Both Lame parameters of the membrane [N/m]."""
BENDING = 1e-6
"""Flexural rigidity [N m]."""
RADIUS = 0.1
"""Of the sphere [m]; its middle is the origin."""
TOUCH = 4e-3
"""Distance at which a vertex touches [m], and the thickness of self-contact at 1000 triangles."""
CONTACT = {"stiffness": 5.0, "damping": 1e-3, "friction_damping": 1e-3, "friction": 0.3}
"""Law of contact with the sphere; times the area of a cell over that of 1000 triangles."""
GRAVITY = -9.81
SPEED = -0.5
"""Velocity of the sheet at the start, along y [m/s]."""

STEP = 2e-4
"""Of central differences by the sphere's height [m]."""


def cell(num_triangles: int) -> float:
    """Side of a cell [m]."""
    return LENGTH[num_triangles] / CELLS[num_triangles][1]


def start(num_triangles: int, flat: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Positions just before contact, and velocities: downward, with noise unless ``flat``; order of ``thin.sheet``."""
    rng, (nx, nz), a = np.random.default_rng(0), CELLS[num_triangles], cell(num_triangles)
    x, z = np.meshgrid(a * (np.arange(nx + 1) - nx / 2), a * (np.arange(nz + 1) - nz / 2), indexing="ij")
    position = np.stack([x.ravel(), np.full(x.size, RADIUS + TOUCH), z.ravel()], axis=-1)
    velocity = np.tile([0.0, SPEED, 0.0], (len(position), 1))
    noise = 0.0 if flat else 1.0
    position += noise * 0.02 * a * rng.standard_normal(position.shape)
    velocity += noise * 0.05 * rng.standard_normal(velocity.shape)
    return position.astype(np.float32), velocity.astype(np.float32)


def triangles(num_triangles: int) -> np.ndarray:
    """Those of ``thin.sheet``: the diagonals of neighbouring cells alternate."""
    nx, nz = CELLS[num_triangles]
    found = []
    for i in range(nx):
        for k in range(nz):
            a, b, c, d = (p * (nz + 1) + q for p, q in ((i, k), (i, k + 1), (i + 1, k + 1), (i + 1, k)))
            found += [(a, b, c), (a, c, d)] if (i + k) % 2 == 0 else [(a, b, d), (b, c, d)]
    return np.asarray(found, np.int32)


def contact(num_triangles: int) -> dict[str, float]:
    """``CONTACT`` for the mass of this sheet's vertices; the coefficient of friction stays."""
    factor = (cell(num_triangles) / cell(1000)) ** 2
    return {name: value if name == "friction" else factor * value for name, value in CONTACT.items()}


def serve(worker: Any) -> None:
    """Answer lines ``OPERATION NUM_SUBSTEPS`` until standard input ends."""
    out, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        operation, count = line.split()
        try:
            began, used = time.perf_counter(), time.process_time()
            answer = getattr(worker, operation)(int(count))
            answer |= {"seconds": time.perf_counter() - began, "processor": time.process_time() - used}
        except Exception as error:
            traceback.print_exc()
            answer = {"error": repr(error)}
        print(json.dumps(answer), file=out, flush=True)
