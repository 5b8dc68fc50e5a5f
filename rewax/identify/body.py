"""The initial body of a fit from the first cloud: a height field or a convex hull, filled with particles."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.wrappers import _Wrapper

_TRIES = 200_000
"""Lattice points of the body's box, of which those inside are particles."""
KINDS = ("height", "hull")


def with_body(env: Any, cloud: np.ndarray, *, kind: str = "height", floor: float | None = None) -> Any:
    """An environment whose particles fill the body that the first cloud of a record shows.

    The number of particles stays, their volume changes. A height field fills everything between the floor and the
    highest seen points, so it needs to see the body from above. A hull fills the smallest convex body around the points
    and their shadow on the floor.

    Args:
      env: with ``rest_positions``, one material and one volume of all particles.
      cloud: seen points [m], shape (n, 3), of the body alone.
      kind: of ``KINDS``.
      floor: height [m]; None: of the lower wall along ``env.up``, or of the lowest point.

    Raises:
      ValueError: in one sentence: the environment or the cloud cannot be used.
    """
    rest, scene = particles_at_rest(env)
    if kind not in KINDS:
        raise ValueError(f"kind is {kind!r}: give one of {', '.join(map(repr, KINDS))}")
    up = np.asarray(env.up, float)
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) < 0.999 or up[axis] < 0.0:
        raise ValueError(f"up is {up}: a body can be filled where up is along a positive axis")
    cloud = np.asarray(cloud, float)
    cloud = cloud[np.isfinite(cloud).all(1)]
    if len(cloud) < 20:
        raise ValueError(f"the cloud has {len(cloud)} points: a body needs at least 20")
    wall = scene.walls.lower[axis] if floor is None and scene.walls is not None else None
    bottom = float(cloud[:, axis].min()) if floor is None else floor
    bottom = bottom if wall is None else float(wall.position)
    points, volume = filled(cloud, bottom, axis, len(rest), kind)
    scene = scene.replace(particle_volume=jnp.asarray(volume / len(rest), jnp.result_type(scene.particle_volume)))
    return env.replace(scene=scene, rest_positions=jnp.asarray(points, rest.dtype))


def particles_at_rest(env: Any) -> tuple[np.ndarray, Any]:
    """The particles of an environment at rest [m], shape (n, 3), and its scene.

    Raises:
      ValueError: it has none, or particles of different volumes or materials, or is a wrapper.
    """
    if isinstance(env, _Wrapper):
        raise ValueError(f"{type(env).__name__} is wrapped around a task: change the task's body, then wrap it")
    rest = getattr(env, "rest_positions", None)
    scene: Any = getattr(env, "scene", None)
    if rest is None or not hasattr(scene, "particle_volume"):
        raise ValueError(f"{type(env).__name__} has no particles at rest_positions: build its body by hand")
    if jnp.ndim(scene.particle_volume) > 0:
        raise ValueError(f"the particles of {type(env).__name__} have different volumes: build its body by hand")
    if isinstance(scene.material, tuple) or any(jnp.ndim(leaf) for leaf in jax.tree.leaves(scene.material)):
        raise ValueError(f"the particles of {type(env).__name__} have different materials: build its body by hand")
    return np.asarray(rest), scene


def filled(cloud: np.ndarray, floor: float, axis: int, count: int, kind: str) -> tuple[np.ndarray, float]:
    """``count`` points inside a body [m], shape (count, 3), evenly spread, and its volume [m^3]."""
    low, high = cloud.min(0), cloud.max(0)
    low[axis] = floor
    size = np.maximum(high - low, 1e-9)
    spacing = float((size.prod() / _TRIES) ** (1.0 / 3.0))
    axes = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    inside = lattice[(_below_heights if kind == "height" else _in_hull)(lattice, cloud, floor, axis)]
    if len(inside) < count:
        raise ValueError(
            f"the body of the cloud has room for {len(inside)} particles, {count} are needed: check floor, {floor:g}"
        )
    return evenly_spread(inside, count), len(inside) * spacing**3


def _below_heights(lattice: np.ndarray, cloud: np.ndarray, floor: float, axis: int) -> np.ndarray:
    """Points between the floor and the highest points of the cloud, interpolated inside of their outline."""
    from scipy.interpolate import LinearNDInterpolator

    flat = [i for i in range(3) if i != axis]
    cell = np.sqrt(np.ptp(cloud[:, flat], axis=0).prod() / len(cloud)) * 2.0
    number = np.floor((cloud[:, flat] - cloud[:, flat].min(0)) / max(cell, 1e-9)).astype(int)
    order = np.lexsort((-cloud[:, axis], number[:, 1], number[:, 0]))
    highest = cloud[order[np.unique(number[order], axis=0, return_index=True)[1]]]
    outline = cloud[_hull_vertices(cloud[:, flat])]
    top = np.concatenate([highest, outline])
    top = top[np.unique(top[:, flat], axis=0, return_index=True)[1]]
    height = LinearNDInterpolator(top[:, flat], top[:, axis])(lattice[:, flat])
    return np.nan_to_num(height, nan=-np.inf) > lattice[:, axis]


def _in_hull(lattice: np.ndarray, cloud: np.ndarray, floor: float, axis: int) -> np.ndarray:
    """Points inside the convex hull of the cloud and its shadow on the floor."""
    from scipy.spatial import Delaunay

    shadow = cloud.copy()
    shadow[:, axis] = floor
    hull = np.concatenate([cloud, shadow])
    return Delaunay(hull[_hull_vertices(hull)]).find_simplex(lattice) >= 0


def _hull_vertices(points: np.ndarray) -> np.ndarray:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(points).vertices
    except QhullError:
        raise ValueError("the points of the cloud lie on a line or in a plane: a body needs more") from None


def evenly_spread(points: np.ndarray, count: int) -> np.ndarray:
    """A subset of evenly spread points: one of each cell of their box, and others at random up to the count."""
    low, size = points.min(0), np.maximum(np.ptp(points, axis=0), 1e-9)
    generator = np.random.Generator(np.random.PCG64(0))
    cells = max(1.0, (len(points) / count) ** (1.0 / 3.0))
    bins = np.maximum(1, np.round(size / (cells * (size.prod() / len(points)) ** (1.0 / 3.0)))).astype(int)
    number = np.minimum(np.floor((points - low) * (bins / size)).astype(int), bins - 1)
    order = generator.permutation(len(points))
    _, first = np.unique(number[order], axis=0, return_index=True)  # one of each cell
    chosen = order[np.sort(first)]
    rest = np.setdiff1d(order, chosen, assume_unique=True)
    chosen = np.concatenate([generator.permutation(chosen), generator.permutation(rest)])
    return points[np.sort(chosen[:count])]


__all__ = ["KINDS", "evenly_spread", "filled", "particles_at_rest", "with_body"]
