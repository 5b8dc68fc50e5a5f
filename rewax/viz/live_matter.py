"""How the live page shows soft matter: the surface of a mesh, balls, or surfaces around particles."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from rewax.viz.balls import ball
from rewax.viz.colors import particle_colors
from rewax.viz.recording import Recording, diameters
from rewax.viz.surface import Surface, surfaces

ROOT = "/episode"
"""Parent of what an episode shows: it moves where the camera follows."""
_GAMMA = 2.2
"""viser takes colours of batched meshes and of vertices in linear space: sRGB to this power."""


class Matter(Protocol):
    """Soft matter of one recording on the page."""

    def draw(self, frame: int) -> None:
        """Show a frame."""

    def recolor(self, by: str) -> None:
        """Colour by the material or a recorded value, from the next ``draw`` on."""

    def positions(self) -> np.ndarray:
        """Positions on the page [m], shape (n, 3): of balls, or of vertices."""
        ...

    def remove(self) -> None:
        """Take it off the page."""


class Body:
    """A mesh of tetrahedra, of cloth or of ropes, by its triangles, in the colours of its particles."""

    def __init__(self, scene: Any, recording: Recording) -> None:
        assert recording.particles is not None
        self._scene, self._recording = scene, recording
        self._vertices = np.asarray(recording.particles, np.float32)
        self._triangles = np.asarray(recording.triangles, int)
        self._colors = _linear(particle_colors(recording, "material"))
        self.draw(0)

    def draw(self, frame: int) -> None:
        shown = _trimesh(self._vertices[frame], self._triangles, _in_frame(self._colors, frame))
        self._handle = self._scene.add_mesh_trimesh(f"{ROOT}/body", shown)
        self._shown = frame

    def recolor(self, by: str) -> None:
        self._colors = _linear(particle_colors(self._recording, by))

    def positions(self) -> np.ndarray:
        return self._vertices[self._shown]

    def remove(self) -> None:
        self._handle.remove()


class Balls:
    """Each particle as a ball of its own volume."""

    def __init__(self, scene: Any, recording: Recording) -> None:
        assert recording.particles is not None
        self._recording, self._centers = recording, np.asarray(recording.particles, np.float32)
        self._colors = _linear(particle_colors(recording, "material"))
        self._handle = _balls(
            scene, f"{ROOT}/particles", self._centers[0], diameters(recording), _in_frame(self._colors, 0)
        )

    def draw(self, frame: int) -> None:
        self._handle.batched_positions = self._centers[frame]
        self._handle.batched_colors = _in_frame(self._colors, frame)

    def recolor(self, by: str) -> None:
        self._colors = _linear(particle_colors(self._recording, by))

    def positions(self) -> np.ndarray:
        return np.asarray(self._handle.batched_positions)

    def remove(self) -> None:
        self._handle.remove()


class Surfaces:
    """The surface of each material's particles, and particles that fly alone as balls.

    The surface of a frame is computed when the frame is first shown.
    """

    def __init__(self, scene: Any, recording: Recording) -> None:
        self._scene, self._recording = scene, recording
        self._colors = _linear(particle_colors(recording, "material"))
        self._diameters = diameters(recording)
        self._found: dict[int, list[Surface]] = {}
        self._shown: dict[str, Any] = {}
        self.draw(0)

    def draw(self, frame: int) -> None:
        parts = self._found.get(frame)
        if parts is None:
            parts = self._found[frame] = surfaces(self._recording, frame, sizes=self._diameters)
        colors = _in_frame(self._colors, frame)
        shown: dict[str, Any] = {}
        for i, part in enumerate(parts):
            name = f"{ROOT}/surfaces/{i}"
            shown[name] = self._scene.add_mesh_trimesh(
                name, _trimesh(part.vertices, part.triangles, colors[part.nearest], part.normals)
            )
        loose = np.concatenate([np.asarray(part.loose, int) for part in parts]) if parts else np.zeros(0, int)
        if len(loose):
            assert self._recording.particles is not None
            centers = np.asarray(self._recording.particles[frame], np.float32)[loose]
            shown[f"{ROOT}/loose"] = _balls(
                self._scene, f"{ROOT}/loose", centers, self._diameters[loose], colors[loose]
            )
        for name, handle in self._shown.items():
            if name not in shown:
                handle.remove()
        self._shown, self._parts = shown, parts

    def recolor(self, by: str) -> None:
        self._colors = _linear(particle_colors(self._recording, by))

    def positions(self) -> np.ndarray:
        return np.concatenate([np.zeros((0, 3)), *(part.vertices for part in self._parts)])

    def remove(self) -> None:
        for handle in self._shown.values():
            handle.remove()


def _trimesh(vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray, normals: np.ndarray | None = None) -> Any:
    """A mesh with a colour at each vertex, and by default with smooth normals."""
    import trimesh  # viser depends on it

    made = trimesh.Trimesh(vertices, triangles, vertex_normals=normals, vertex_colors=colors, process=False)
    _ = made.vertex_normals  # it exports those that it has computed
    return made


def _balls(scene: Any, name: str, centers: np.ndarray, diameter: np.ndarray, colors: np.ndarray) -> Any:
    vertices, triangles = ball()
    return scene.add_batched_meshes_simple(
        name,
        vertices,
        triangles,
        batched_wxyzs=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(centers), 1)),
        batched_positions=centers,
        batched_scales=(0.5 * diameter).astype(np.float32),
        batched_colors=colors,
        lod="off",
    )


def _linear(colors: np.ndarray) -> np.ndarray:
    return np.round(255.0 * colors**_GAMMA).astype(np.uint8)


def _in_frame(colors: np.ndarray, frame: int) -> np.ndarray:
    return colors if colors.ndim == 2 else colors[frame]


KINDS: dict[str, Callable[[Any, Recording], Matter]] = {"body": Body, "balls": Balls, "surface": Surfaces}


__all__ = ["KINDS", "Balls", "Body", "Matter", "Surfaces"]
