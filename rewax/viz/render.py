"""Pictures of a recording, drawn with MuJoCo's OpenGL renderer or with NumPy."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from rewax.viz.colors import color_by as colors_of
from rewax.viz.recording import Recording
from rewax.viz.skin import skinned
from rewax.viz.surface import has_surfaces

RENDERERS = ("auto", "mujoco", "software")


def pictures(
    recording: Recording,
    *,
    size: tuple[int, int] = (360, 480),
    renderer: str = "auto",
    color_by: str = "material",
    surface: bool | None = None,
) -> Iterator[np.ndarray]:
    """Draw every frame of a recording.

    Args:
      recording: what to show.
      size: height and width in pixels.
      renderer: ``mujoco`` needs OpenGL through EGL or OSMesa; ``software`` needs only NumPy. ``auto`` uses
        ``mujoco`` if OpenGL runs on a graphics card and no surfaces are shown, and ``software`` otherwise. If MuJoCo's
        drawing process dies, ``auto`` draws the remaining frames with ``software``.
      color_by: quantity that determines the colour of particles: ``material``, ``height``, ``speed``, ``strain``.
      surface: True draws the surfaces of materials, False draws particles as balls. None draws surfaces unless the
        renderer is ``mujoco``, which cannot draw them.

    Returns:
      Pictures in order, uint8 of shape (height, width, 3).

    Raises:
      ValueError: the renderer is unknown, the recording has no quantity ``color_by``, ``mujoco`` finds no OpenGL, or
        surfaces are requested from ``mujoco``.
    """
    if renderer not in RENDERERS:
        raise ValueError(f"renderer is {renderer!r}: use one of {', '.join(RENDERERS)}")
    if recording.particles is not None and color_by not in colors_of(recording):
        raise ValueError(f"particles cannot be coloured by {color_by!r}: use one of {', '.join(colors_of(recording))}")
    if surface and renderer == "mujoco":
        raise ValueError("the renderer mujoco draws no surfaces of particles: use software or auto")
    recording = skinned(recording)
    wanted = surface is not False and renderer != "mujoco" and has_surfaces(recording)
    if wanted or renderer == "software":
        return software_pictures(recording, size, color_by, surface=wanted)
    from rewax.viz.opengl import find_opengl

    found = find_opengl()
    if renderer == "mujoco":
        if found is None:
            raise ValueError(
                "no OpenGL was found, neither EGL nor OSMesa: install one (apt-get install libegl1 or libosmesa6), or "
                "use the renderer software"
            )
        from rewax.viz.opengl import mujoco_pictures

        return mujoco_pictures(recording, size, color_by, found.name)
    if found is None or not found.hardware:
        return software_pictures(recording, size, color_by)
    return _or_software(recording, size, color_by, found.name)


def software_pictures(
    recording: Recording, size: tuple[int, int], color_by: str, *, surface: bool = False, start: int = 0
) -> Iterator[np.ndarray]:
    """Draw pictures with NumPy, several at a time in threads, from the frame ``start`` on."""
    from rewax.viz.software import SoftwareRenderer

    drawn = SoftwareRenderer(recording, height=size[0], width=size[1], color_by=color_by, surface=surface)
    threads = max(1, min(4, os.cpu_count() or 1))
    with ThreadPoolExecutor(threads) as pool:
        for first in range(start, recording.num_frames, 4 * threads):  # limits the memory of finished pictures
            yield from pool.map(drawn.render, range(first, min(first + 4 * threads, recording.num_frames)))


def _or_software(recording: Recording, size: tuple[int, int], color_by: str, backend: str) -> Iterator[np.ndarray]:
    """Draw with MuJoCo; if its process dies, draw the remaining frames with the software renderer."""
    from rewax.viz.opengl import mujoco_pictures

    done = 0
    try:
        for picture in mujoco_pictures(recording, size, color_by, backend):
            yield picture
            done += 1
    except OSError:  # the drawing process has died
        yield from software_pictures(recording, size, color_by, start=done)  # framed and coloured as a whole


__all__ = ["RENDERERS", "pictures", "software_pictures"]
