"""An environment on another grid, for fits at several resolutions."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.identify.body import evenly_spread, particles_at_rest
from rewax.physics.mpm import Grid, make_scene

_TRIES = 400_000
"""Lattice points of the body's box, of which those inside are candidates for particles."""
_BEHIND = 2
"""Least number of nodes below a lower wall."""


def with_cells(env: Any, cells: float) -> Any:
    """An environment on a grid of ``cells`` cells per metre.

    The body keeps its volume and its number of particles per cell, a control step keeps its duration and its number of
    substeps per cell, and the box keeps its size. Lower walls lie on nodes. Tools reach one cell (``softness=None``): a
    shorter reach makes the result depend on the grid in an irregular way.

    Args:
      env: with ``rest_positions``, one material and one volume of all particles, and ``num_substeps``.
      cells: per metre, > 0.

    Raises:
      ValueError: in one sentence: the environment cannot be changed so, or the number is illegal.
    """
    rest, scene = particles_at_rest(env)
    if hasattr(env, "model"):
        raise ValueError(f"{type(env).__name__} has a robot with substeps of its own: build its grids by hand")
    if not hasattr(env, "num_substeps"):
        raise ValueError(f"{type(env).__name__} has no num_substeps: build its grids by hand")
    if not (math.isfinite(cells) and cells > 0.0):
        raise ValueError(f"cells is {cells}: give the number of cells per metre, above 0")
    old, finer = scene.grid, cells * scene.grid.spacing
    steps = max(1, math.ceil(env.num_substeps * finer - 1e-6))
    count = max(1, round(len(rest) * finer**3))
    volume = float(scene.particle_volume) * len(rest)
    new = make_scene(
        grid=_grid(old, scene.walls.lower, 1.0 / cells), dt=float(env.control_dt) / steps, material=scene.material,
        particle_volume=jnp.asarray(volume / count, jnp.result_type(scene.particle_volume)), gravity=scene.gravity,
        colliders=tuple(c.replace(softness=None) for c in scene.colliders), walls=scene.walls, overlap=scene.overlap,
        max_near_colliders=scene.max_near_colliders,
    )  # fmt: skip
    points = jnp.asarray(resampled(rest, volume, count), jnp.result_type(env.rest_positions))
    lists = {name: value for name, value in (("list_every", None), ("store_every", 1)) if hasattr(env, name)}
    try:
        changed = env.replace(scene=new, rest_positions=points, num_substeps=steps, **lists)
        jax.eval_shape(changed.reset, jax.random.key(0))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{type(env).__name__} needs its own particles ({error}): build its grids by hand") from error
    return changed


def _grid(old: Grid, walls: tuple[Any, ...], spacing: float) -> Grid:
    """A grid of another spacing that covers the old one, with lower walls on nodes."""
    origin, shape = [], []
    for axis, wall in enumerate(walls):
        low, top = old.origin[axis], old.origin[axis] + (old.shape[axis] - 1) * old.spacing
        if wall is not None:
            below = max(_BEHIND, math.ceil((wall.position - low) / spacing - 1e-6))
            low = wall.position - below * spacing
        origin.append(low)
        shape.append(math.ceil((top - low) / spacing - 1e-6) + 1)
    return Grid(shape=(shape[0], shape[1], shape[2]), spacing=spacing, origin=(origin[0], origin[1], origin[2]))


def resampled(rest: np.ndarray, volume: float, count: int) -> np.ndarray:
    """Another number of particles in the same body [m], shape (count, 3).

    The body is what lies nearest to the particles and has their volume.

    Args:
      rest: particles [m], shape (n, 3).
      volume: of all of them [m^3].
      count: number of new particles.
    """
    from scipy.spatial import KDTree

    margin = (volume / len(rest)) ** (1.0 / 3.0)
    low, high = rest.min(0) - margin, rest.max(0) + margin
    spacing = float(((high - low).prod() / _TRIES) ** (1.0 / 3.0))
    axes = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    distance = KDTree(rest).query(lattice)[0]
    inside = max(count, min(len(lattice), round(volume / spacing**3)))
    return evenly_spread(lattice[np.sort(np.argsort(distance, kind="stable")[:inside])], count)


__all__ = ["resampled", "with_cells"]
