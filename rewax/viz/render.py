"""Pictures of a recording, drawn by the best renderer on this machine."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from rewax.viz.colors import color_by as colors_of
from rewax.viz.recording import Recording
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
      renderer: ``mujoco`` needs OpenGL through EGL or OSMesa; ``software`` needs NumPy alone; ``auto`` takes MuJoCo's
        where a graphics card draws and no surfaces are shown, and continues with ``software`` if it fails.
      color_by: what colours particles: ``material``, ``height``, ``speed``, ``strain``.
      surface: show particles by the surfaces of their materials (True) or as balls (False). None shows surfaces unless
        the renderer is ``mujoco``, which draws none.

    Returns:
      Pictures in order, uint8 of shape (height, width, 3).

    Raises:
      ValueError: an unknown renderer, no value named ``color_by``, no OpenGL for ``mujoco``, or surfaces with it.
    """
    if renderer not in RENDERERS:
        raise ValueError(f"renderer is {renderer!r}: use one of {', '.join(RENDERERS)}")
    if recording.particles is not None and color_by not in colors_of(recording):
        raise ValueError(f"particles cannot be coloured by {color_by!r}: use one of {', '.join(colors_of(recording))}")
    if surface and renderer == "mujoco":
        raise ValueError("the renderer mujoco draws no surfaces of particles: use software or auto")
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
    recording: Recording, size: tuple[int, int], color_by: str, *, surface: bool = False
) -> Iterator[np.ndarray]:
    """Pictures drawn with NumPy, several at a time in threads."""
    from rewax.viz.software import SoftwareRenderer

    drawn = SoftwareRenderer(recording, height=size[0], width=size[1], color_by=color_by, surface=surface)
    threads = max(1, min(4, os.cpu_count() or 1))
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, recording.num_frames, 4 * threads):  # bounds the memory of finished pictures
            yield from pool.map(drawn.render, range(first, min(first + 4 * threads, recording.num_frames)))


def _or_software(recording: Recording, size: tuple[int, int], color_by: str, backend: str) -> Iterator[np.ndarray]:
    """MuJoCo's pictures; if it fails, the rest come from the software renderer."""
    from rewax.viz.opengl import mujoco_pictures

    done = 0
    try:
        for picture in mujoco_pictures(recording, size, color_by, backend):
            yield picture
            done += 1
    except OSError:  # the drawing process has died
        yield from software_pictures(recording.take(range(done, recording.num_frames)), size, color_by)


__all__ = ["RENDERERS", "pictures", "software_pictures"]
