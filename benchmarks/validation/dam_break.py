"""A column of water collapses: the front on the floor against Martin and Moyce (1952).

Their square-sided column, twice as high as its width a (their n^2 = 2), with Z = front / a over T = t sqrt(2 g / a).
Tait's law, frictionless floor, plane strain (their channel had glass walls 2.25 in apart).
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, fill, held, record, save
from rewax.physics import mpm
from rewax.physics.active_nodes import count_nodes
from rewax.physics.colliders import Wall, Walls
from rewax.physics.grid import Grid
from rewax.physics.materials import Elasticity, Material

TABLE_2 = np.array([
    (0.41, 1.11), (0.84, 1.22), (1.19, 1.44), (1.43, 1.67), (1.63, 1.89), (1.83, 2.11), (1.98, 2.33), (2.20, 2.56),
    (2.32, 2.78), (2.51, 3.00), (2.65, 3.22), (2.83, 3.44), (2.98, 3.67), (3.11, 3.89), (3.33, 4.11),
])  # fmt: skip
"""T and Z of a = 2.25 in, n^2 = 2: Martin and Moyce 1952, table 2."""
FIGURE_3_SMALL = np.array([(0.849, 1.245), (1.212, 1.443), (1.602, 1.884), (2.283, 2.689), (2.950, 3.728), (3.598, 4.528)])
"""T and Z of a = 1.125 in, n^2 = 2, read off their figure 3."""
FIGURE_3_LARGE = np.array([(0.832, 1.217), (1.219, 1.474), (1.997, 2.292), (2.547, 2.995), (3.345, 4.134)])
"""T and Z of a = 2.25 in, n^2 = 2, read off their figure 3."""
