"""Which sphere or triangle is nearest in each pixel: many at once, with numpy alone."""

import numpy as np

_NOTHING = np.uint64(np.iinfo(np.uint64).max)
_LOW = np.uint64(0xFFFFFFFF)
_CHUNK = 300_000
"""Pixels that are worked on at once, which bounds the memory."""


class NearestBuffer:
    """The nearest thing in every pixel.

    Args:
      height, width: of the picture in pixels.
    """

    def __init__(self, height: int, width: int) -> None:
        self.height, self.width = height, width
        self._keys = np.full(height * width, _NOTHING)

    def add_spheres(self, columns: np.ndarray, rows: np.ndarray, depths: np.ndarray, radii: np.ndarray) -> None:
        """Spheres 0, 1, ... at places in the picture [pixels], at depths > 0, with radii [pixels], shape (n,) each.

        Their bulge is left out of the depth kept: what is nearer by its middle covers what is behind.
        """
        groups = np.maximum(1, np.ceil(radii)).astype(int)
        for size in np.unique(groups):
            members = np.flatnonzero(groups == size)
            dy, dx = (part.reshape(-1) for part in np.mgrid[-size : size + 1, -size : size + 1])
            disc = dx * dx + dy * dy <= (size + 0.5) ** 2
            dx, dy = dx[disc], dy[disc]
            for some in np.array_split(members, 1 + len(members) * len(dx) // _CHUNK):
                x = np.floor(columns[some]).astype(np.int32)[:, None] + dx.astype(np.int32)
                y = np.floor(rows[some]).astype(np.int32)[:, None] + dy.astype(np.int32)
                square = (x + 0.5 - columns[some, None]) ** 2 + (y + 0.5 - rows[some, None]) ** 2
                inside = square <= (radii[some] ** 2)[:, None]
                inside &= (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
                key = _pack(depths[some], some)
                self._offer((y * self.width + x)[inside], np.broadcast_to(key[:, None], x.shape)[inside])

    def add_triangles(self, corners: np.ndarray) -> None:
        """Triangles 0, 1, ...: columns, rows and depths > 0 of their corners, shape (n, 3, 3)."""
        low = np.floor(corners[..., :2].min(axis=1)).astype(int)
        high = np.ceil(corners[..., :2].max(axis=1)).astype(int)
        shown = np.all((high > 0) & (low < [self.width, self.height]), axis=1) & (corners[..., 2].min(axis=1) > 0.0)
        low = np.maximum(low, 0)
        size = np.minimum(high, [self.width, self.height]) - low
        groups = 2 ** np.ceil(np.log2(np.maximum(size.max(axis=1), 1))).astype(int)
        for edge in np.unique(groups[shown]):
            members = np.flatnonzero(shown & (groups == edge))
            for some in np.array_split(members, 1 + len(members) * edge * edge // _CHUNK):
                self._add_squares(some, corners[some], low[some], int(edge))

    def _add_squares(self, index: np.ndarray, corners: np.ndarray, low: np.ndarray, edge: int) -> None:
        """Add triangles that lie in squares of ``edge`` pixels, whose first pixels are ``low``."""
        dy, dx = (part.reshape(-1) for part in np.mgrid[:edge, :edge].astype(np.int32))
        x, y = low[:, :1].astype(np.int32) + dx, low[:, 1:].astype(np.int32) + dy
        px, py = (part.astype(np.float32) + np.float32(0.5) for part in (x, y))
        corners = corners.astype(np.float32)
        weights = []
        for i in range(3):
            (ax, ay), (bx, by) = (corners[:, (i + k) % 3, :2].T for k in (1, 2))
            weights.append((bx - ax)[:, None] * (py - ay[:, None]) - (by - ay)[:, None] * (px - ax[:, None]))
        area = weights[0] + weights[1] + weights[2]
        sign = np.sign(area)
        inside = (weights[0] * sign >= 0) & (weights[1] * sign >= 0) & (weights[2] * sign >= 0) & (area != 0)
        inside &= (x < self.width) & (y < self.height)
        inverse = sum(w / corners[:, i, 2, None] for i, w in enumerate(weights))
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (area / inverse)[inside]
        which = np.broadcast_to(index[:, None], inside.shape)[inside]
        self._offer((y * self.width + x)[inside], _pack(depth, which))

    def _offer(self, pixels: np.ndarray, keys: np.ndarray) -> None:
        np.minimum.at(self._keys, pixels, keys)

    def result(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Covered pixels, the index of the nearest item in each, and its depth, shape (num_covered,) each."""
        pixels = np.flatnonzero(self._keys != _NOTHING)
        keys = self._keys[pixels]
        return pixels, (keys & _LOW).astype(np.int64), (keys >> np.uint64(32)).astype(np.uint32).view(np.float32)


def _pack(depths: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Keys that sort by depth, then by index: positive floats sort like their bits."""
    return (depths.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)) | index.astype(np.uint64)


__all__ = ["NearestBuffer"]
