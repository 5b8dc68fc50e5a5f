"""A renderer in NumPy: particles as surfaces or lit balls, exact rigid shapes, a floor with shadows."""

import numpy as np

from rewax.viz.buffers import NearestBuffer
from rewax.viz.camera import Camera, Framing, focal_length, frame_recording
from rewax.viz.colors import particle_colors, shape_color
from rewax.viz.ground import Ground, sky
from rewax.viz.meshes import Mesh, mesh
from rewax.viz.raycast import hit, turned
from rewax.viz.recording import Recording, diameters
from rewax.viz.shapes import Drawing, placed, support
from rewax.viz.surface import has_surfaces, surfaces

_SAMPLES = 2
"""Samples along each edge of a pixel; its colour is their mean."""


class SoftwareRenderer:
    """Pictures of a recording.

    Args:
      recording: what to show.
      height, width: of a picture in pixels.
      color_by: what colours particles, see ``rewax.viz.colors.color_by``.
      surface: show particles by the surfaces of their materials (``rewax.viz.surface``) instead of spheres.
      framing: where the camera stands in each frame; by default it shows the whole recording.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        height: int,
        width: int,
        color_by: str = "material",
        surface: bool = False,
        framing: Framing | None = None,
    ) -> None:
        self._recording, self._size = recording, (height, width)
        self._surface = surface and has_surfaces(recording)
        self._rows, self._columns = _SAMPLES * height, _SAMPLES * width
        self._framing = framing or frame_recording(recording, aspect=width / height)
        self._up = np.asarray(recording.up, float)
        camera = self._framing.camera(0, self._up)  # all cameras of a recording look in the same direction
        self._axes = np.stack([camera.right, camera.up, -camera.forward]).astype(np.float32)
        light = 0.35 * camera.right + 0.95 * self._up - 0.35 * camera.forward
        self._light = (light / np.linalg.norm(light)).astype(np.float32)
        self._rays = _rays(camera, self._rows, self._columns)
        self._ground = Ground(
            _rays(camera, height, width),
            self._up,
            self._framing.floor,
            self._framing.radius,
            self._light.astype(float),
            sky(height, width),
            1.0 / focal_length(height),
        )
        self._diameters = None if recording.particles is None else diameters(recording)
        self._radii = None if self._diameters is None else (0.5 * self._diameters).astype(np.float32)
        self._colors = None if recording.particles is None else particle_colors(recording, color_by)
        first = [shape for shape in recording.shapes(0) if shape["kind"] != "plane"]
        self._meshes = [mesh(shape) if shape["kind"] == "mesh" else None for shape in first]

    def render(self, frame: int) -> np.ndarray:
        """Picture of a frame, uint8 of shape (height, width, 3)."""
        camera = self._framing.camera(frame, self._up)
        shapes = [shape for shape in self._recording.shapes(frame) if shape["kind"] != "plane"]
        cloud = None if self._recording.particles is None else self._recording.particles[frame]
        back, floor = self._ground.draw(
            camera,
            self._framing.targets[frame],
            [(shape, shape_color(shape)[1]) for shape in shapes],
            cloud,
            self._radii,
            self._recording.triangles,
        )
        depth = self._enlarge(floor * np.float32(1.0 + 1e-4))
        picture = self._enlarge(back)
        if cloud is not None:
            self._draw_cloud(camera, cloud, frame, depth, picture)
        far = [float(np.asarray(shape["center"]) @ camera.forward) for shape in shapes]
        behind_first = np.argsort(-np.array(far), kind="stable")
        for opaque in (True, False):
            for i in behind_first:
                if (shape_color(shapes[i])[1] >= 1.0) == opaque:
                    self._draw_shape(camera, shapes[i], self._meshes[i], depth, picture)
        grid = picture.reshape(self._rows, self._columns, 3)
        total = sum(grid[i::_SAMPLES, j::_SAMPLES] for i in range(_SAMPLES) for j in range(_SAMPLES))
        return (np.clip(total, 0.0, _SAMPLES**2) * np.float32(255.0 / _SAMPLES**2) + np.float32(0.5)).astype(np.uint8)

    def _draw_cloud(
        self, camera: Camera, cloud: np.ndarray, frame: int, depth: np.ndarray, picture: np.ndarray
    ) -> None:
        """Spheres, or the surface of a mesh, or surfaces around particles."""
        assert self._colors is not None
        colors = self._colors if self._colors.ndim == 2 else self._colors[frame]
        triangles = self._recording.triangles
        if triangles is not None:
            corners = cloud[triangles]
            faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), 1e-12)
            self._draw_triangles(camera, corners, faces, colors[triangles].mean(axis=1), depth, picture)
        elif self._surface:
            for part in surfaces(self._recording, frame, sizes=self._diameters):
                corners, normals = part.vertices[part.triangles], part.normals[part.triangles]
                color = colors[part.nearest][part.triangles].mean(axis=1)
                self._draw_triangles(camera, corners, normals, color, depth, picture)
                self._draw_spheres(camera, cloud, part.loose, colors, depth, picture)
        else:
            self._draw_spheres(camera, cloud, np.arange(len(cloud)), colors, depth, picture)

    def _draw_triangles(
        self,
        camera: Camera,
        corners: np.ndarray,
        normals: np.ndarray,
        colors: np.ndarray,
        depth: np.ndarray,
        picture: np.ndarray,
    ) -> None:
        """Triangles with corners of shape (n, 3, 3), a colour each, and a normal each, (n, 3), or for each corner."""
        buffer = NearestBuffer(self._rows, self._columns)
        buffer.add_triangles(np.stack(camera.project(corners, self._rows, self._columns), axis=-1).astype(np.float32))
        pixels, which, at = buffer.result()
        shown = at < depth[pixels]
        pixels, which, at = pixels[shown], which[shown], at[shown]
        depth[pixels] = at
        normal = normals[which]
        if normals.ndim == 3:
            normal = _interpolated(camera.eye + at[:, None] * self._rays[pixels], corners[which], normal)
        picture[pixels] = self._shade(normal.astype(np.float32), colors[which])

    def _draw_spheres(
        self,
        camera: Camera,
        cloud: np.ndarray,
        members: np.ndarray,
        colors: np.ndarray,
        depth: np.ndarray,
        picture: np.ndarray,
    ) -> None:
        """Some of the particles as spheres."""
        assert self._radii is not None
        buffer = NearestBuffer(self._rows, self._columns)
        column, row, far = (a.astype(np.float32) for a in camera.project(cloud, self._rows, self._columns))
        seen = members[far[members] > 0.02 * camera.distance]
        radius = np.zeros_like(far)
        radius[seen] = np.clip(self._radii[seen] * focal_length(self._rows) / far[seen], 0.75, 400.0)
        buffer.add_spheres(column[seen], row[seen], far[seen], radius[seen])
        pixels, which, at = buffer.result()
        which = seen[which]
        shown = at - self._radii[which] < depth[pixels]
        pixels, which, at = pixels[shown], which[shown], at[shown]
        x = (pixels % self._columns + 0.5 - column[which]) / radius[which]
        y = (row[which] - pixels // self._columns - 0.5) / radius[which]
        z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
        normal, color = turned(np.stack([x, y, z], axis=1), self._axes), colors[which]
        at = at - self._radii[which] * z
        shown = at < depth[pixels]
        pixels, at, normal, color = pixels[shown], at[shown], normal[shown], color[shown]
        depth[pixels] = at
        picture[pixels] = self._shade(normal, color)

    def _draw_shape(
        self, camera: Camera, shape: Drawing, surface: Mesh | None, depth: np.ndarray, picture: np.ndarray
    ) -> None:
        """Draw a rigid shape in the pixels where it is nearest."""
        seen = self._see_shape(camera, shape) if surface is None else self._see_mesh(camera, shape, surface)
        pixels, at, normal = seen
        shown = np.flatnonzero(at < depth[pixels])
        pixels, normal = pixels[shown], normal[shown].astype(np.float32)
        color, opacity = shape_color(shape)
        shaded = self._shade(normal, color)
        if opacity >= 1.0:
            depth[pixels], picture[pixels] = at[shown], shaded
        else:
            picture[pixels] += opacity * (shaded - picture[pixels])

    def _see_shape(self, camera: Camera, shape: Drawing) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels that may show a shape; depths, infinite where they do not, and normals there."""
        low, high = self._rectangle(camera, shape)
        rows, columns = np.arange(low[1], high[1]), np.arange(low[0], high[0])
        pixels = (rows[:, None] * self._columns + columns).reshape(-1)
        return pixels, *hit(shape, camera.eye, self._rays[pixels])

    def _see_mesh(self, camera: Camera, shape: Drawing, surface: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels that show a mesh; depths and normals there, the latter between those of the triangle's corners."""
        vertices = placed(shape, surface.vertices)
        projected = np.stack(camera.project(vertices, self._rows, self._columns), axis=-1)
        buffer = NearestBuffer(self._rows, self._columns)
        buffer.add_triangles(projected[surface.triangles].astype(np.float32))
        pixels, which, at = buffer.result()
        points = camera.eye + at[:, None] * self._rays[pixels]
        corners = surface.triangles[which]
        normals = _interpolated(points, vertices[corners], surface.normals[corners])
        return pixels, at, turned(normals, np.asarray(shape["rotation"], float).T)

    def _rectangle(self, camera: Camera, shape: Drawing) -> tuple[np.ndarray, np.ndarray]:
        """First and last column and row that may show a shape; all of them for one that reaches behind the eye."""
        axes = np.stack([camera.right, camera.up, camera.forward])
        reach = np.stack([support(shape, sign * axes) for sign in (-1.0, 1.0)])  # end, axis, point
        low, high = ((reach[i] - camera.eye) @ axes.T for i in (0, 1))
        low, high = np.diagonal(low), np.diagonal(high)
        whole = np.array([self._columns, self._rows])
        if low[2] < 0.02 * camera.distance:
            return np.zeros(2, int), whole
        scale = focal_length(self._rows)
        x, y, z = (part.reshape(-1) for part in np.meshgrid(*np.stack([low, high], axis=1)))
        corner = scale * np.stack([x, -y], axis=1) / z[:, None] + 0.5 * whole
        first, last = np.floor(corner.min(axis=0)).astype(int) - 1, np.ceil(corner.max(axis=0)).astype(int) + 1
        return np.clip(first, 0, whole), np.clip(last, 0, whole)

    def _shade(self, normal: np.ndarray, color: np.ndarray) -> np.ndarray:
        """Colours under light from the sky, from the eye and from a lamp, with a small highlight."""
        lamp = np.maximum(normal @ self._light, 0.0)
        from_sky = 0.5 + 0.5 * (normal @ self._up.astype(np.float32))
        halfway = self._light + self._axes[2]
        gleam = np.maximum(normal @ (halfway / np.linalg.norm(halfway)), 0.0) ** 24
        fill = np.maximum(normal @ self._axes[2], 0.0)
        light = 0.30 + 0.22 * from_sky + 0.20 * fill + 0.46 * lamp
        return (light[:, None] * color + 0.14 * gleam[:, None]).astype(np.float32)

    def _enlarge(self, pixels: np.ndarray) -> np.ndarray:
        """Repeat each pixel for its samples, shape (num_samples, ...)."""
        height, width = self._size
        large = np.empty((height, _SAMPLES, width, _SAMPLES, *pixels.shape[1:]), np.float32)
        large[:] = pixels.reshape(height, 1, width, 1, *pixels.shape[1:])
        return large.reshape(self._rows * self._columns, *pixels.shape[1:])


def _interpolated(points: np.ndarray, corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit normals at points of triangles, weighted by the areas opposite to their corners.

    Args:
      points: shape (n, 3).
      corners, normals: of each point's triangle, shape (n, 3, 3).
    """
    opposite = [np.cross(corners[:, i - 2] - points, corners[:, i - 1] - points) for i in range(3)]
    face = sum(opposite)
    share = np.stack([np.einsum("ni,ni->n", part, face) for part in opposite], axis=1)
    normal = np.einsum("nc,nci->ni", np.maximum(share, 0.0), normals)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _rays(camera: Camera, rows: int, columns: int) -> np.ndarray:
    """Directions through the middles of all pixels, shape (rows * columns, 3), with a length of 1 along the axis."""
    scale = focal_length(rows)
    x = ((np.arange(columns) + 0.5 - 0.5 * columns) / scale)[None, :, None]
    y = ((0.5 * rows - np.arange(rows) - 0.5) / scale)[:, None, None]
    return (camera.forward + x * camera.right + y * camera.up).reshape(-1, 3).astype(np.float32)


__all__ = ["SoftwareRenderer"]
