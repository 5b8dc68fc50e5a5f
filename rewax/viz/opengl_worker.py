"""The process that draws with MuJoCo: ``python -m rewax.viz.opengl_worker probe | draw``, see ``rewax.viz.opengl``."""

# pyright: reportAttributeAccessIssue=false

import pickle
import sys
from typing import Any

import mujoco
import numpy as np

from rewax.viz.camera import FIELD_OF_VIEW, frame_recording
from rewax.viz.colors import particle_colors, shape_color
from rewax.viz.ground import FLOOR, SKY_BOTTOM, SKY_TOP, grid_spacing
from rewax.viz.meshes import mesh, pose
from rewax.viz.recording import Recording, diameters
from rewax.viz.shapes import Drawing, side_view

_SCENE = """
<mujoco>
  <visual>
    <global fovy="{fov}" offwidth="{width}" offheight="{height}"/>
    <quality offsamples="4" shadowsize="4096"/>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.35 0.35 0.35" specular="0 0 0"/>
    <map znear="0.05" zfar="25" shadowclip="2.5"/>
    <rgba haze="{sky_bottom} 1"/>
  </visual>
  <statistic center="0 0 0" extent="{extent}"/>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="{sky_bottom}" rgb2="{sky_top}" width="64" height="384"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1="{floor}" rgb2="{tile}"
      width="256" height="256"/>
    <material name="tiles" texture="tiles" texuniform="true" texrepeat="{repeat} {repeat}"
      specular="0" emission="0.25"/>
  </asset>
  <worldbody>
    <light directional="true" dir="{light}" diffuse="0.5 0.5 0.5" specular="0.2 0.2 0.2"/>
    <geom type="plane" size="0 0 1" pos="0 0 {floor_height}" material="tiles"/>
  </worldbody>
</mujoco>
"""


_AS_MESHES = ("cone", "mesh")
"""Kinds of shapes that the MuJoCo model of the scene holds as meshes."""
_LIGHT = np.array([-0.3, 0.3, -0.9])
"""Direction in which the lamp shines."""


class _Painter:
    """MuJoCo's scene, filled anew for each frame; its z axis is the recording's ``up``."""

    def __init__(self, recording: Recording, size: tuple[int, int], color_by: str) -> None:
        height, width = size
        self._recording = recording
        self._framing = frame_recording(recording, aspect=width / height)
        side = side_view(recording.up)
        self._turn = np.stack([side.right, -side.towards, side.up])
        radius = self._framing.radius
        text = _SCENE.format(
            fov=FIELD_OF_VIEW,
            width=width,
            height=height,
            extent=radius,
            light=_words(_LIGHT),
            repeat=0.5 / grid_spacing(radius),
            floor_height=self._framing.floor,
            sky_top=_words(SKY_TOP),
            sky_bottom=_words(SKY_BOTTOM),
            floor=_words(FLOOR),
            tile=_words(0.9 * FLOOR),
        )
        self._meshes: dict[int, int] = {}
        model = self._with_meshes(mujoco.MjSpec.from_string(text)).compile()
        self._data = mujoco.MjData(model)
        mujoco.mj_forward(model, self._data)
        count = (
            0
            if recording.particles is None
            else max(recording.particles.shape[1], 0 if recording.triangles is None else len(recording.triangles))
        )
        shapes = len(recording.shapes(0))
        self._renderer = mujoco.Renderer(model, height, width, max_geom=count + shapes + 16)
        self._radii = None if recording.particles is None else 0.5 * diameters(recording)
        self._colors = None if recording.particles is None else particle_colors(recording, color_by)

    def driver(self) -> str:
        """The driver's name of its renderer."""
        from OpenGL import GL

        context = getattr(self._renderer, "_gl_context", None)
        if context is not None:
            context.make_current()
        name = GL.glGetString(GL.GL_RENDERER)
        return name.decode() if isinstance(name, bytes) else "unknown driver"

    def paint(self, frame: int) -> np.ndarray:
        """Picture of a frame, uint8 of shape (height, width, 3)."""
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = self._turn @ self._framing.targets[frame]
        camera.distance, camera.azimuth = self._framing.distance, 90.0 + self._framing.azimuth
        camera.elevation = -self._framing.elevation
        self._renderer.update_scene(self._data, camera)
        for light in self._renderer.scene.lights[: self._renderer.scene.nlight]:
            if not light.headlight:  # shadows are drawn about the line along which it shines
                light.pos[:] = camera.lookat - 6.0 * self._framing.radius * _LIGHT / np.linalg.norm(_LIGHT)
        if self._recording.particles is not None:
            self._add_cloud(self._recording.particles[frame].astype(float) @ self._turn.T, frame)
        for i, shape in enumerate(self._recording.shapes(frame)):
            if i in self._meshes:
                self._add_mesh(shape, self._meshes[i])
            elif shape["kind"] not in ("plane", *_AS_MESHES):
                self._add_shape(shape)
        return self._renderer.render()

    def _with_meshes(self, scene: Any) -> Any:
        """The scene's model with the meshes of cones and mesh shapes. Meshes without area are left out."""
        surfaces = {i: mesh(s) for i, s in enumerate(self._recording.shapes(0)) if s["kind"] in _AS_MESHES}
        for i, (vertices, normals, triangles) in surfaces.items():
            a, b, c = (vertices[triangles[:, k]] for k in range(3))
            if np.abs(np.cross(b - a, c - a)).sum() < 1e-12:
                continue
            self._meshes[i], added = len(self._meshes), scene.add_mesh(name=f"mesh {i}")
            added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # also defined for open meshes
            rows = (np.concatenate([part, part[:1]]) for part in (vertices, normals))  # MuJoCo needs four vertices
            added.uservert, added.usernormal = (part.reshape(-1) for part in rows)
            added.userface = added.userfacenormal = triangles.reshape(-1)
        return scene

    def _add_cloud(self, cloud: np.ndarray, frame: int) -> None:
        assert self._colors is not None and self._radii is not None
        colors = self._colors if self._colors.ndim == 2 else self._colors[frame]
        triangles, turn = self._recording.triangles, np.eye(3)
        if triangles is None:
            for i, center in enumerate(cloud):
                self._add(mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, self._radii[i]), center, turn, colors[i], 1.0)
            return
        for corners in triangles:
            first, second, third = cloud[corners]
            edges = second - first, third - first
            normal = np.cross(*edges)
            frame_of = np.stack([*edges, normal / max(np.linalg.norm(normal), 1e-12)], axis=1)
            color = colors[corners].mean(axis=0)
            self._add(mujoco.mjtGeom.mjGEOM_TRIANGLE, np.ones(3), first, frame_of, color, 1.0)

    def _add_shape(self, shape: Drawing) -> None:
        kind, (color, opacity) = shape["kind"], shape_color(shape)
        center = self._turn @ np.asarray(shape["center"], float)
        geom = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
        if kind in ("box", "ellipsoid"):
            rotation = self._turn @ np.asarray(shape["rotation"], float)
            size = np.asarray(shape["half_size" if kind == "box" else "semi_axes"], float)
            self._add(geom, size, center, rotation, color, opacity)
            return
        radius = float(shape["radius"])
        length = radius if kind == "sphere" else float(shape["half_length"])
        axis = np.array([0.0, 0.0, 1.0]) if kind == "sphere" else self._turn @ np.asarray(shape["direction"], float)
        self._add(geom, np.array([radius, length, 0.0]), center, _along(axis), color, opacity)

    def _add_mesh(self, shape: Drawing, number: int) -> None:
        """Add a mesh shape. MuJoCo has moved the mesh to its centre of mass and its axes of inertia."""
        (color, opacity), (center, quaternion), model = shape_color(shape), pose(shape), self._renderer.model
        rotation = self._turn @ _rotation(quaternion[[3, 0, 1, 2]])
        center = self._turn @ center + rotation @ model.mesh_pos[number]
        turn = rotation @ _rotation(model.mesh_quat[number])
        self._add(mujoco.mjtGeom.mjGEOM_MESH, np.ones(3), center, turn, color, opacity)
        self._renderer.scene.geoms[self._renderer.scene.ngeom - 1].dataid = 2 * number  # odd: its convex hull

    def _add(
        self, kind: Any, size: np.ndarray, center: np.ndarray, rotation: np.ndarray, color: np.ndarray, opacity: float
    ) -> None:
        scene = self._renderer.scene
        rgba = np.array([*color, opacity], np.float32)
        mujoco.mjv_initGeom(scene.geoms[scene.ngeom], kind, size, center, rotation.reshape(-1), rgba)
        scene.ngeom += 1


def _along(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is along an axis."""
    third = axis / np.linalg.norm(axis)
    first = np.cross(third, np.eye(3)[int(np.argmin(np.abs(third)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third], axis=1)


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Matrix of a unit quaternion (w, x, y, z)."""
    found = np.zeros(9)
    mujoco.mju_quat2Mat(found, quaternion)
    return found.reshape(3, 3)


def _words(color: np.ndarray) -> str:
    return " ".join(f"{part:.4g}" for part in color)


def _probe() -> Recording:
    """A ball on the floor."""
    ball = {"kind": "sphere", "center": np.array([0.0, 0.1, 0.0]), "radius": 0.1}
    return Recording(steps=np.zeros(1, int), rewards=np.zeros(0), status=np.zeros(0, int), drawings=[[ball]])


def main(what: str) -> int:
    """Draw the recording on the standard input, or a small one to find out which driver draws."""
    if what == "probe":
        painter = _Painter(_probe(), (48, 64), "material")
        picture = painter.paint(0)
        print(painter.driver())
        return int(picture.std() < 1.0)  # a driver may draw nothing
    recording, size, color_by = pickle.load(sys.stdin.buffer)
    painter = _Painter(recording, size, color_by)
    for frame in range(recording.num_frames):
        sys.stdout.buffer.write(np.ascontiguousarray(painter.paint(frame)).tobytes())
    sys.stdout.buffer.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
