"""A page that shows one episode after the other while it stays open in the browser; viser serves it."""

import contextlib
import errno
import io
import socket
import threading
import time
from typing import Any

import numpy as np

from rewax.viz.camera import FIELD_OF_VIEW, Framing, frame_recording
from rewax.viz.colors import color_by, shape_color
from rewax.viz.ground import grid_spacing
from rewax.viz.live_guard import guarded
from rewax.viz.live_matter import KINDS, ROOT, Matter
from rewax.viz.looks import Look, looks
from rewax.viz.meshes import mesh, pose
from rewax.viz.recording import Recording, playback
from rewax.viz.skin import skinned
from rewax.viz.surface import has_surfaces

_TICK = 1.0 / 30.0
"""Time between frames on the page [s]."""
_HOLD = 0.5
"""How long the last frame of an episode stays before the first one follows, at speed 1 of the page [s]."""


class LiveViewer:
    """A page that plays a recording again and again until another one replaces it.

    Pages of other sites cannot connect to it (``rewax.viz.live_guard``).

    Args:
      host, port: address of the page. Only this machine can open 127.0.0.1. Port 0 chooses a free port.

    Attributes:
      url: address of the page.

    Raises:
      ValueError: viser is not installed, or the port is taken.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        try:
            import viser
        except ImportError:
            raise ValueError("a live view needs viser: pip install 'rewax[live]'") from None
        port = _free_port(host, port)
        self._server: Any = None
        with contextlib.redirect_stdout(io.StringIO()):  # the caller prints the address
            try:
                with guarded(host):
                    self._server = viser.ViserServer(host=host, port=port, label="rewax", verbose=False)
            except ValueError:
                if self._server is not None:  # it is not guarded
                    self._server.stop()
                raise
        self.url = f"http://{host}:{port}"
        self._lock, self._closed = threading.RLock(), threading.Event()
        self._recording: Recording | None = None
        self._framing: Framing | None = None
        self._root: Any = None
        self._solids: list[tuple[Look, Any]] = []
        self._matter: Matter | None = None
        self._time, self._duration, self._speed, self._shown = 0.0, 0.0, 1.0, -1
        gui = self._server.gui
        self._text = gui.add_markdown("")
        self._playing = gui.add_checkbox("play", True)
        self._rate = gui.add_slider("speed", min=0.05, max=2.0, step=0.05, initial_value=1.0)
        self._timeline = gui.add_slider("time [%]", min=0.0, max=100.0, step=0.1, initial_value=0.0)
        self._by = gui.add_dropdown("colour by", ("material",))
        self._surface = gui.add_checkbox("surface", True, hint="Show the surface of particles, or balls.")
        self._timeline.on_update(lambda event: self.seek(self._timeline.value / 100.0) if event.client else None)
        self._by.on_update(lambda _: self._recolor())
        self._surface.on_update(lambda _: self._rebuild())
        threading.Thread(target=self._animate, daemon=True).start()

    def show(self, recording: Recording, caption: str = "") -> None:
        """Replace the episode on the page and play the new one from its beginning.

        Args:
          recording: the episode.
          caption: text beside it, in Markdown.
        """
        recording = skinned(recording)
        with self._lock:
            self._server.scene.reset()
            first = self._recording is None  # later episodes keep the user's camera
            self._recording, self._framing = recording, frame_recording(recording)
            self._duration, self._speed = float(recording.times[-1]), playback(recording)[2]
            self._time, self._shown, self._text.content = 0.0, -1, caption
            self._build(recording, self._framing)
            self._draw(0)
            if first:
                for camera in (self._server.initial_camera, *(c.camera for c in self._server.get_clients().values())):
                    self._place(camera)

    def seek(self, part: float) -> int:
        """Go to a fraction of the episode, from 0 to 1; returns the frame that the page then shows."""
        with self._lock:
            if self._recording is None:
                return 0
            self._time = float(np.clip(part, 0.0, 1.0)) * self._duration
            frame = int(np.argmin(np.abs(self._recording.times - self._time)))
            self._draw(frame)
            return frame

    def positions(self) -> np.ndarray:
        """Positions of the balls or of the surface's vertices that the page shows [m], shape (n, 3).

        They are those of the recording: where the camera follows, the page shifts everything. n is 0 without particles.
        """
        with self._lock:
            return np.zeros((0, 3), np.float32) if self._matter is None else self._matter.positions()

    def close(self) -> None:
        """Stop serving the page."""
        self._closed.set()
        with self._lock, contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _build(self, recording: Recording, framing: Framing) -> None:
        """Create the floor, the solids and the particles of an episode, in its first frame.

        The user turns the camera, so it stays; where it should follow, everything is shifted instead.
        """
        scene, up = self._server.scene, np.asarray(recording.up, float)
        scene.set_up_direction(tuple(float(x) for x in up))
        scene.configure_environment_map("city", environment_intensity=0.25)
        low, high = framing.targets.min(axis=0), framing.targets.max(axis=0)
        middle, size = 0.5 * (low + high), 4.0 * framing.radius + float((high - low).max())
        planes = {0: "yz", 1: "xz", 2: "xy"}
        self._root = scene.add_frame(ROOT, show_axes=False)
        scene.add_grid(
            f"{ROOT}/floor",
            width=size,
            height=size,
            plane=planes[int(np.argmax(np.abs(up)))],
            cell_size=grid_spacing(framing.radius),
            position=tuple(middle + (framing.floor - middle @ up) * up),
        )
        self._solids = []
        for k, look in enumerate(looks(recording)):
            surface, (color, opacity) = mesh(look.drawing), shape_color(look.drawing)
            handle = scene.add_mesh_simple(
                f"{ROOT}/solids/{k}",
                np.asarray(surface.vertices, np.float32),
                np.asarray(surface.triangles, np.uint32),
                color=tuple(float(x) for x in color),
                opacity=None if opacity >= 1.0 else opacity,
            )
            self._solids.append((look, handle))
        self._matter = None
        if recording.particles is not None:
            self._by.options = color_by(recording)
            self._surface.visible = has_surfaces(recording)
            self._build_matter(recording)

    def _build_matter(self, recording: Recording) -> None:
        kind = "body" if not has_surfaces(recording) else "surface" if self._surface.value else "balls"
        self._matter = KINDS[kind](self._server.scene, recording)
        self._matter.recolor(self._by.value)

    def _draw(self, frame: int) -> None:
        """Move solids and particles to their poses in a frame, and all of them so that the camera follows."""
        recording, framing = self._recording, self._framing
        if recording is None or framing is None or frame == self._shown:
            return
        with self._server.atomic():
            self._root.position = tuple(framing.targets[0] - framing.targets[frame])
            for look, handle in self._solids:
                place, turn = pose(recording.shapes(frame)[look.number])
                handle.visible = look.shown is None or bool(look.shown[frame])
                handle.position, handle.wxyz = tuple(place), (turn[3], *turn[:3])
            if self._matter is not None:
                self._matter.draw(frame)
        self._timeline.value = 100.0 * float(recording.times[frame]) / max(self._duration, 1e-9)
        self._shown = frame

    def _recolor(self) -> None:
        with self._lock:
            if self._matter is not None:
                self._matter.recolor(self._by.value)
                self._redraw()

    def _rebuild(self) -> None:
        """Show matter the other way: by surfaces or by balls."""
        with self._lock:
            if self._matter is not None and self._recording is not None:
                self._matter.remove()
                self._build_matter(self._recording)
                self._redraw()

    def _redraw(self) -> None:
        frame, self._shown = max(self._shown, 0), -1
        self._draw(frame)

    def _place(self, camera: Any) -> None:
        """Give a camera of the page the view that pictures of the recording have."""
        assert self._recording is not None and self._framing is not None
        up = np.asarray(self._recording.up, float)
        camera_0 = self._framing.camera(0, up)
        setattr(camera, "up" if hasattr(camera, "up") else "up_direction", tuple(up))
        camera.position, camera.look_at = tuple(camera_0.eye), tuple(self._framing.targets[0])
        camera.fov = float(np.radians(FIELD_OF_VIEW))

    def _animate(self) -> None:
        before = time.monotonic()
        while not self._closed.wait(_TICK):
            now = time.monotonic()
            with self._lock:
                if self._closed.is_set():
                    return
                if self._recording is not None and self._playing.value and self._duration > 0.0:
                    self._advance(self._recording, (now - before) * self._rate.value)
            before = now

    def _advance(self, recording: Recording, seconds: float) -> None:
        """Play on. The last frame stays for a while; a page that is too slow for all frames shows it, too."""
        self._time += seconds * self._speed
        if self._shown < recording.num_frames - 1:
            self._time = min(self._time, self._duration)
        elif self._time > self._duration + _HOLD * self._speed:
            self._time = 0.0
        self._draw(int(np.searchsorted(recording.times, self._time, side="right")) - 1)


def _free_port(host: str, port: int) -> int:
    """The port, checked to be free; for 0 any free port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            other = "port" if error.errno in (errno.EADDRINUSE, errno.EACCES) else "host, 127.0.0.1 for this machine"
            raise ValueError(f"{host}:{port} cannot be served ({error.strerror}): choose another {other}") from None
        return int(probe.getsockname()[1])


__all__ = ["LiveViewer"]
