"""Where rays meet spheres, capsules, cylinders and boxes: exact depths and normals for the software renderer."""

import numpy as np

from rewax.viz.shapes import Drawing

_FAR = np.float32(np.inf)


def hit(drawing: Drawing, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet a shape first.

    Args:
      drawing: of a shape that is not a plane, checked.
      eye: where all rays begin [m], shape (3,).
      rays: their directions, of any length, shape (num_rays, 3).

    Returns:
      Depths in units of the rays' lengths, infinite where a ray misses, shape (num_rays,); outward unit normals there,
      shape (num_rays, 3).
    """
    start = (np.asarray(eye) - np.asarray(drawing["center"], float)).astype(np.float32)
    kind = drawing["kind"]
    if kind == "box":
        axes = np.asarray(drawing["rotation"], np.float32)
        depth, normal = _box(np.asarray(drawing["half_size"], np.float32), start @ axes, turned(rays, axes))
        return depth, turned(normal, axes.T)
    radius = np.float32(drawing["radius"])
    if kind == "sphere":
        return _sphere(radius, start, rays)
    axis = np.asarray(drawing["direction"], np.float32)
    axis = axis / np.linalg.norm(axis)
    half = np.float32(drawing["half_length"])
    side = _side(radius, half, axis, start, rays)
    ends = [
        _sphere(radius, start - end * half * axis, rays)
        if kind == "capsule"
        else _cap(radius, half, end * axis, start, rays)
        for end in (-1.0, 1.0)
    ]
    return _nearest([side, *ends])


def turned(vectors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``vectors @ matrix``, shapes (n, 3) and (3, m). A product this narrow costs BLAS's threads more than it saves."""
    return np.einsum("ni,ij->nj", vectors, matrix)


def _nearest(hits: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    depth, normal = hits[0]
    for other, direction in hits[1:]:
        nearer = other < depth
        depth, normal = np.where(nearer, other, depth), np.where(nearer[:, None], direction, normal)
    return depth, normal


def _roots(a: np.ndarray, b: np.ndarray, c: np.ndarray | np.float32) -> np.ndarray:
    """The smaller root of a t^2 + 2 b t + c where it is positive, else infinite."""
    square = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        root = (-b - np.sqrt(square)) / a
    return np.where((square > 0.0) & (root > 0.0), root, _FAR)


def _sphere(radius: np.float32, start: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    start = start.astype(np.float32)
    depth = _roots(np.einsum("ni,ni->n", rays, rays), rays @ start, start @ start - radius**2)
    return depth, _point(start, rays, depth) / max(radius, np.float32(1e-12))


def _side(
    radius: np.float32, half: np.float32, axis: np.ndarray, start: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The curved side of a cylinder."""
    along = rays @ axis
    across, begin = rays - along[:, None] * axis, start - (start @ axis) * axis
    depth = _roots(np.maximum(np.einsum("ni,ni->n", across, across), 1e-12), across @ begin, begin @ begin - radius**2)
    finite = np.where(np.isfinite(depth), depth, 0.0)
    depth = np.where(np.abs(start @ axis + finite * along) <= half, depth, _FAR)
    return depth, _point(begin, across, depth) / max(radius, np.float32(1e-12))


def _cap(
    radius: np.float32, half: np.float32, outward: np.ndarray, start: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The flat end of a cylinder."""
    along = rays @ outward
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (half - start @ outward) / along
    depth = np.where((along < 0.0) & (depth > 0.0), depth, _FAR).astype(np.float32)
    point = _point(start, rays, depth)
    across = point - (point @ outward)[:, None] * outward
    depth = np.where(np.einsum("ni,ni->n", across, across) <= radius**2, depth, _FAR)
    return depth, np.broadcast_to(outward.astype(np.float32), rays.shape)


def _box(half_size: np.ndarray, start: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """In the box's own axes."""
    slope = np.where(np.abs(rays) < 1e-9, np.float32(1e-9), rays)
    first, second = (-half_size - start) / slope, (half_size - start) / slope
    near, far = np.minimum(first, second), np.maximum(first, second)
    entry = np.maximum(np.maximum(near[:, 0], near[:, 1]), near[:, 2])
    exit_ = np.minimum(np.minimum(far[:, 0], far[:, 1]), far[:, 2])
    depth = np.where((entry <= exit_) & (entry > 0.0), entry, _FAR)
    normal = np.where(near >= entry[:, None], -np.sign(slope), 0.0)
    return depth, normal.astype(np.float32)


def _point(start: np.ndarray, rays: np.ndarray, depth: np.ndarray) -> np.ndarray:
    return start + np.where(np.isfinite(depth), depth, 0.0)[:, None] * rays


__all__ = ["hit", "turned"]
