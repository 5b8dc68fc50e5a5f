"""The floor of a picture: a grid that fades into the distance, and the shadows of the objects above it."""

from typing import NamedTuple

import numpy as np

from rewax.viz.buffers import NearestBuffer
from rewax.viz.camera import Camera
from rewax.viz.raycast import turned
from rewax.viz.shapes import Drawing, View, outline, placed

SKY_TOP, SKY_BOTTOM = np.array([0.86, 0.90, 0.95], np.float32), np.array([0.97, 0.98, 0.99], np.float32)
FLOOR = np.array([0.80, 0.82, 0.85], np.float32)
_SHADOW = 0.5
_TEXELS = 192
_HORIZON = 3.2
"""Distance at which the floor has faded, in radii of the scene."""


def sky(height: int, width: int) -> np.ndarray:
    """The background, shape (height * width, 3)."""
    part = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    colors = (1.0 - part) * SKY_TOP + part * SKY_BOTTOM
    return np.broadcast_to(colors, (height, width, 3)).reshape(-1, 3)


def grid_spacing(radius: float) -> float:
    """Spacing of the lines [m]: 1, 2 or 5 times a power of ten, so that about eight lines cross the scene."""
    wanted = radius / 4.0
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted * 1.0001))


class _Background(NamedTuple):
    """The floor as a camera sees it.

    Attributes:
      depth: of the floor in each pixel, shape (num_pixels,).
      pixels: that show the floor, shape (n,).
      floor: its share of their colours, shape (n, 3).
      colors: of all pixels, shape (num_pixels, 3).
      corner: of the picture of the shadow, along the light [m], shape (2,).
      texels: of that picture, shape (n,).
    """

    depth: np.ndarray
    pixels: np.ndarray
    floor: np.ndarray
    colors: np.ndarray
    corner: np.ndarray
    texels: np.ndarray


class Ground:
    """A level floor seen along fixed rays.

    Args:
      rays: of all pixels, with a length of 1 along the camera's axis, shape (num_pixels, 3).
      up: unit vector that points up in the world, shape (3,).
      height: of the floor along it [m].
      radius: of a ball that holds all that is shown [m].
      towards_light: unit vector, shape (3,).
      background: colours where there is no floor, shape (num_pixels, 3).
      pixel: width of a pixel at distance 1.
    """

    def __init__(
        self,
        rays: np.ndarray,
        up: np.ndarray,
        height: float,
        radius: float,
        towards_light: np.ndarray,
        background: np.ndarray,
        pixel: float,
    ) -> None:
        self._up, self._height, self._radius, self._background, self._pixel = up, height, radius, background, pixel
        self._slope = rays @ up.astype(np.float32)
        self._rays, self._spacing = rays, grid_spacing(radius)
        across = np.eye(3)[int(np.argmin(np.abs(up)))]
        self._axes = np.stack([np.cross(up, across), np.cross(up, np.cross(up, across))])
        self._axes /= np.linalg.norm(self._axes, axis=1, keepdims=True)
        right = np.cross(towards_light, self._axes[0])
        right /= np.linalg.norm(right)
        self._light = View(right, np.cross(towards_light, right))
        self._reach = 1.3 * radius
        self._cached: tuple[bytes, _Background] | None = None

    def draw(
        self,
        camera: Camera,
        target: np.ndarray,
        shapes: list[tuple[Drawing, float]],
        cloud: np.ndarray | None,
        radii: np.ndarray | None,
        triangles: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours of the sky and the floor with the shadows on it, and depths of the floor.

        Args:
          camera: the camera of the frame.
          target: middle of the scene [m], shape (3,).
          shapes: shapes that cast shadows, each with its opacity.
          cloud, radii: particles that cast shadows [m], or None.
          triangles: of particles that are the vertices of a mesh, or None.

        Returns:
          Colours, shape (num_pixels, 3), and depths, shape (num_pixels,), infinite where there is no floor.
        """
        background = self._floor(camera, target)
        colors = background.colors.copy()
        shadow = self._shadow(background.corner, shapes, cloud, radii, triangles).reshape(-1)
        dark = shadow[background.texels]
        touched = np.flatnonzero(dark > 0.003)
        colors[background.pixels[touched]] -= _SHADOW * dark[touched, None] * background.floor[touched]
        return colors, background.depth

    def _floor(self, camera: Camera, target: np.ndarray) -> _Background:
        """The parts of the floor that stay the same while the camera rests."""
        key = camera.eye.tobytes()
        if self._cached is not None and self._cached[0] == key:
            return self._cached[1]
        above = float(camera.eye @ self._up - self._height)
        with np.errstate(divide="ignore"):
            depth = np.where(self._slope * above < 0.0, -above / self._slope, np.inf).astype(np.float32)
        pixels = np.flatnonzero(depth < camera.distance + _HORIZON * self._radius)
        near, rays = depth[pixels], self._rays[pixels]
        points = camera.eye.astype(np.float32) + near[:, None] * rays
        offset = points - np.asarray(target, np.float32)
        away = np.sqrt(np.einsum("ni,ni->n", offset, offset)) * np.float32(1.0 / (_HORIZON * self._radius))
        fade = np.minimum(away, 1.0)[:, None] ** 1.5
        footprint = near * np.float32(self._pixel) / np.maximum(np.abs(self._slope[pixels]), np.float32(0.05))
        floor = (1.0 - fade) * (1.0 - 0.16 * self._lines(points, footprint))[:, None] * FLOOR
        colors = self._background.copy()
        colors[pixels] = fade * colors[pixels] + floor
        corner = (self._light.project(np.asarray(target)) - self._reach).astype(np.float32)
        axes = np.stack([self._light.right, self._light.up], axis=1).astype(np.float32)
        place = (turned(points, axes) - corner) * np.float32(_TEXELS / (2.0 * self._reach))
        texels = place.astype(np.int32)
        texels = np.clip(texels, 0, _TEXELS - 1) @ np.array([1, _TEXELS], np.int32)
        background = _Background(depth, pixels, floor.astype(np.float32), colors, corner, texels)
        self._cached = (key, background)
        return background

    def _lines(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Share of each pixel that a grid line covers, between 0 and 1."""
        found = np.zeros(len(points), np.float32)
        width = np.maximum(np.float32(0.012 * self._spacing), np.float32(0.6) * footprint)
        for axis in self._axes:
            place = points @ (axis / self._spacing).astype(np.float32)
            from_line = np.abs(place - np.round(place)) * np.float32(self._spacing)
            found = np.maximum(found, 1.5 - from_line / width)
        faint = np.minimum(np.float32(0.3 * self._spacing) / footprint, 1.0)
        return np.minimum(found, 1.0) * faint

    def _shadow(
        self,
        corner: np.ndarray,
        shapes: list[tuple[Drawing, float]],
        cloud: np.ndarray | None,
        radii: np.ndarray | None,
        triangles: np.ndarray | None,
    ) -> np.ndarray:
        """Darkness of the floor as a shadow map seen along the light, shape (_TEXELS, _TEXELS)."""
        texel = 2.0 * self._reach / _TEXELS
        dark = np.zeros((_TEXELS, _TEXELS), np.float32)
        if cloud is not None and radii is not None:
            place = (self._light.project(cloud) - corner) / texel
            if triangles is None:
                buffer = NearestBuffer(_TEXELS, _TEXELS)
                buffer.add_spheres(place[:, 0], place[:, 1], np.ones(len(place)), np.clip(radii / texel, 1.0, 24.0))
                dark.reshape(-1)[buffer.result()[0]] = 1.0
            else:
                _fill_triangles(place, triangles, dark, 1.0)
        for shape, opacity in shapes:
            if shape["kind"] == "mesh":
                vertices = placed(shape, np.asarray(shape["vertices"], float))
                place = (self._light.project(vertices) - corner) / texel
                _fill_triangles(place, np.asarray(shape["triangles"], int), dark, opacity)
            else:
                _fill((outline(shape, self._light, num_points=24) - corner) / texel, dark, opacity)
        dark[[0, -1]] = dark[:, [0, -1]] = 0.0  # no shadow beyond the map
        return _blur(_blur(dark))


def _fill_triangles(place: np.ndarray, triangles: np.ndarray, dark: np.ndarray, value: float) -> None:
    """Darken the inside of triangles; their vertices are [texels], shape (num_vertices, 2)."""
    buffer = NearestBuffer(_TEXELS, _TEXELS)
    buffer.add_triangles(np.concatenate([place, np.ones((len(place), 1))], axis=1)[triangles])
    inside = buffer.result()[0]
    flat = dark.reshape(-1)
    flat[inside] = np.maximum(flat[inside], value)


def _fill(polygon: np.ndarray, dark: np.ndarray, value: float) -> None:
    """Darken the inside of a convex polygon whose corners [texels] are counter-clockwise."""
    low = np.clip(np.floor(polygon.min(axis=0)).astype(int), 0, _TEXELS)
    high = np.clip(np.ceil(polygon.max(axis=0)).astype(int) + 1, 0, _TEXELS)
    if np.any(high <= low):
        return
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
    after = np.roll(polygon, -1, axis=0)
    edge = after - polygon
    cross = edge[:, 0, None, None] * (y - polygon[:, 1, None, None]) - edge[:, 1, None, None] * (
        x - polygon[:, 0, None, None]
    )
    inside = np.all(cross >= -1e-9, axis=0)
    part = dark[low[1] : high[1], low[0] : high[0]]
    part[inside] = np.maximum(part[inside], value)


def _blur(picture: np.ndarray) -> np.ndarray:
    """Blur: the mean over three neighbours along each axis, twice."""
    for _ in range(2):
        picture = (picture + np.roll(picture, 1, 0) + np.roll(picture, -1, 0)) / 3.0
        picture = (picture + np.roll(picture, 1, 1) + np.roll(picture, -1, 1)) / 3.0
    return picture


__all__ = ["FLOOR", "SKY_BOTTOM", "SKY_TOP", "Ground", "grid_spacing", "sky"]
