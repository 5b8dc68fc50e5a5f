"""Ray casting: exact depths and normals of the shapes that are not meshes, for the software renderer."""

import numpy as np

from rewax.viz.shapes import Drawing

_FAR = np.float32(np.inf)


def hit(drawing: Drawing, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first intersection of rays with a shape.

    Args:
      drawing: checked drawing of a shape that is neither a plane nor a mesh.
      eye: origin of all rays [m], shape (3,).
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
    if kind == "ellipsoid":
        axes = np.asarray(drawing["rotation"], float)
        depth, normal = _ellipsoid(np.asarray(drawing["semi_axes"], float), start @ axes, turned(rays, axes))
        return depth, turned(normal, axes.T).astype(np.float32)
    radius = np.float32(drawing["radius"])
    if kind == "sphere":
        return _sphere(radius, start, rays)
    axis = np.asarray(drawing["direction"], np.float32)
    axis = axis / np.linalg.norm(axis)
    half = np.float32(drawing["half_length"])
    if kind == "cone":
        return _nearest([*_slant(radius, half, axis, start, rays), _cap(radius, half, -axis, start, rays)])
    side = _side(radius, half, axis, start, rays)
    ends = [
        _sphere(radius, start - end * half * axis, rays)
        if kind == "capsule"
        else _cap(radius, half, end * axis, start, rays)
        for end in (-1.0, 1.0)
    ]
    return _nearest([side, *ends])


def turned(vectors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``vectors @ matrix``, shapes (n, 3) and (3, m). BLAS would spend more time on threads than it saves."""
    return np.einsum("ni,ij->nj", vectors, matrix)


def _nearest(hits: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    depth, normal = hits[0]
    for other, direction in hits[1:]:
        nearer = other < depth
        depth, normal = np.where(nearer, other, depth), np.where(nearer[:, None], direction, normal)
    return depth, normal


def _roots(a: np.ndarray, b: np.ndarray, c: np.ndarray | np.float32) -> np.ndarray:
    """The smaller root of a t^2 + 2 b t + c = 0 where it is positive, otherwise infinity."""
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


def _ellipsoid(semi_axes: np.ndarray, start: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An ellipsoid is a unit ball in its own axes, with lengths in units of the semi-axes."""
    start, rays = start / semi_axes, rays / semi_axes
    depth = _roots(np.einsum("ni,ni->n", rays, rays), rays @ start, start @ start - 1.0)
    normal = _point(start, rays, depth) / semi_axes
    return depth.astype(np.float32), normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _slant(
    radius: np.float32, half: np.float32, axis: np.ndarray, start: np.ndarray, rays: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The curved side of a cone: its radius is ``slope`` times the distance below the tip. A ray may meet it twice."""
    height = max(2.0 * float(half), 1e-6)
    slope, axis = float(radius) / height, axis.astype(float)
    begin = start - float(half) * axis  # from the tip
    fall, below = -(rays @ axis), -float(begin @ axis)
    across, aside = rays + fall[:, None] * axis, begin + below * axis
    a = np.einsum("ni,ni->n", across, across) - slope**2 * fall**2
    a = np.where(np.abs(a) < 1e-12, 1e-12, a)
    b, c = across @ aside - slope**2 * fall * below, aside @ aside - slope**2 * below**2
    square = b * b - a * c
    root = np.sqrt(np.maximum(square, 0.0))
    hits = []
    for depth in ((-b - root) / a, (-b + root) / a):
        fallen = below + depth * fall
        met = (square > 0.0) & (depth > 0.0) & (fallen >= 0.0) & (fallen <= height)
        depth = np.where(met, depth, np.inf)
        outward = _point(aside, across, depth)
        outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
        normal = (outward + slope * axis) / np.sqrt(1.0 + slope**2)
        hits.append((depth.astype(np.float32), normal.astype(np.float32)))
    return hits


def _box(half_size: np.ndarray, start: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A box in its own axes, by the slab method."""
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
