"""How the live page shows soft matter: the surface of a mesh, balls, or surfaces around particles."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from rewax.viz.balls import ball
from rewax.viz.colors import particle_colors
from rewax.viz.recording import Recording, diameters
from rewax.viz.surface import Surface, surfaces

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
    """A mesh of tetrahedra or of cloth, by its triangles, in one colour."""

    def __init__(self, scene: Any, recording: Recording) -> None:
        assert recording.particles is not None
        self._vertices = np.asarray(recording.particles, np.float32)
        color = particle_colors(recording, "material").reshape(-1, 3)[0]
        triangles = np.asarray(recording.triangles, np.uint32)
        self._handle = scene.add_mesh_simple(
            "/body", self._vertices[0], triangles, color=tuple(float(x) for x in color)
        )

    def draw(self, frame: int) -> None:
        self._handle.vertices = self._vertices[frame]

    def recolor(self, by: str) -> None:
        """A mesh has one colour."""

    def positions(self) -> np.ndarray:
        return np.asarray(self._handle.vertices)

    def remove(self) -> None:
        self._handle.remove()


class Balls:
    """Each particle as a ball of its own volume."""

    def __init__(self, scene: Any, recording: Recording) -> None:
        assert recording.particles is not None
        self._recording, self._centers = recording, np.asarray(recording.particles, np.float32)
        self._colors = _linear(particle_colors(recording, "material"))
        self._handle = _balls(scene, "/particles", self._centers[0], diameters(recording), _in_frame(self._colors, 0))

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
            parts = self._found[frame] = surfaces(self._recording, frame)
        colors = _in_frame(self._colors, frame)
        shown: dict[str, Any] = {}
        for i, part in enumerate(parts):
            name = f"/surfaces/{i}"
            shown[name] = self._scene.add_mesh_trimesh(name, _colored(part, colors[part.nearest]))
        loose = np.concatenate([np.asarray(part.loose, int) for part in parts]) if parts else np.zeros(0, int)
        if len(loose):
            assert self._recording.particles is not None
            centers = np.asarray(self._recording.particles[frame], np.float32)[loose]
            shown["/loose"] = _balls(self._scene, "/loose", centers, self._diameters[loose], colors[loose])
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


def _colored(part: Surface, colors: np.ndarray) -> Any:
    import trimesh  # viser depends on it

    return trimesh.Trimesh(
        part.vertices, part.triangles, vertex_normals=part.normals, vertex_colors=colors, process=False
    )


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
