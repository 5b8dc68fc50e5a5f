"""Pictures by MuJoCo's renderer in a process of its own, so that a crashing graphics driver ends only that process."""

import contextlib
import functools
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from typing import IO, NamedTuple

import numpy as np

from rewax.viz.recording import Recording

_BACKENDS = ("egl", "osmesa")
_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software", "unknown")
_PATIENCE = 60.0
"""Longest time for a driver to draw one small picture [s]."""


class OpenGL(NamedTuple):
    """An OpenGL backend that draws without a screen.

    Attributes:
      name: ``egl`` or ``osmesa``.
      renderer: the driver's name of its renderer.
    """

    name: str
    renderer: str

    @property
    def hardware(self) -> bool:
        """Whether a graphics card draws, rather than the processor."""
        return self.name == "egl" and not any(word in self.renderer.lower() for word in _SOFTWARE)


@functools.cache
def find_opengl() -> OpenGL | None:
    """The first of EGL and OSMesa that draws a test picture on this machine; None if neither does.

    The environment variable MUJOCO_GL, if it is set, says which one is tried, and ``disabled`` that none is.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    for name in _BACKENDS if wanted in ("", "glfw") else [name for name in _BACKENDS if name == wanted]:
        try:
            done = subprocess.run(
                _command("probe"), env=_environment(name), capture_output=True, timeout=_PATIENCE, check=False
            )
        except (OSError, subprocess.SubprocessError):
            continue
        output = done.stdout.decode(errors="replace").strip()
        if done.returncode == 0 and output:
            return OpenGL(name, output.splitlines()[-1])
    return None


def mujoco_pictures(recording: Recording, size: tuple[int, int], color_by: str, backend: str) -> Iterator[np.ndarray]:
    """Draw every frame of a recording.

    Args:
      recording: what to show.
      size: height and width in pixels.
      color_by: what colours particles.
      backend: ``egl`` or ``osmesa``.

    Returns:
      Pictures, uint8 of shape (height, width, 3).

    Raises:
      OSError: the drawing process failed; the message has the last line of its error output.
    """
    with tempfile.TemporaryFile() as errors:  # a pipe that nobody reads would fill up, and the process would wait
        process = subprocess.Popen(
            _command("draw"), env=_environment(backend), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
            start_new_session=True,
        )  # fmt: skip
        assert process.stdin is not None and process.stdout is not None
        try:
            try:
                pickle.dump((recording, size, color_by), process.stdin)
                process.stdin.close()
            except OSError:  # it died before it had read everything; its error output follows
                pass
            for _ in range(recording.num_frames):
                content = process.stdout.read(size[0] * size[1] * 3)
                if len(content) < size[0] * size[1] * 3:
                    raise OSError(f"the process that draws with OpenGL ended early; it said: {_said(process, errors)}")
                yield np.frombuffer(content, np.uint8).reshape(*size, 3)
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


def _said(process: subprocess.Popen[bytes], errors: IO[bytes]) -> str:
    """The last line of a process that has closed its output."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_PATIENCE)
    errors.seek(0)
    return (errors.read().decode(errors="replace").strip().splitlines() or ["nothing"])[-1]


def _command(what: str) -> list[str]:
    return [sys.executable, "-m", "rewax.viz.opengl_worker", what]


def _environment(backend: str) -> dict[str, str]:
    return {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend, "JAX_PLATFORMS": "cpu"}


__all__ = ["OpenGL", "find_opengl", "mujoco_pictures"]
