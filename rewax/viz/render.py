"""Pictures of a recording, by the best renderer that this machine has."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from rewax.viz.colors import color_by as colors_of
from rewax.viz.recording import Recording

RENDERERS = ("auto", "mujoco", "software")


def pictures(
    recording: Recording,
    *,
    size: tuple[int, int] = (360, 480),
    renderer: str = "auto",
    color_by: str = "material",
    surface: bool = False,
) -> Iterator[np.ndarray]:
    """Draw every frame of a recording.

    Args:
      recording: what to show.
      size: height and width in pixels.
      renderer: ``mujoco`` needs OpenGL through EGL or OSMesa; ``software`` needs nothing; ``auto`` takes MuJoCo's where
        a graphics card draws, and goes on with the other one if it fails.
      color_by: what colours particles: ``material``, ``height``, ``speed``, ``strain``.
      surface: show particles by the surfaces of their materials, which ``software`` alone draws.

    Returns:
      Pictures in order, uint8 of shape (height, width, 3).

    Raises:
      ValueError: an unknown renderer, nothing of the name ``color_by``, no OpenGL for ``mujoco``, or surfaces with it.
    """
    if renderer not in RENDERERS:
        raise ValueError(f"renderer is {renderer!r}: use one of {', '.join(RENDERERS)}")
    if recording.particles is not None and color_by not in colors_of(recording):
        raise ValueError(f"particles cannot be coloured by {color_by!r}: use one of {', '.join(colors_of(recording))}")
    if surface:
        if renderer == "mujoco":
            raise ValueError("the renderer mujoco draws no surfaces of particles: use software or auto")
        renderer = "software"
    if renderer == "software":
        return software_pictures(recording, size, color_by, surface=surface)
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
    """Pictures by numpy alone, a few at a time in as many threads."""
    from rewax.viz.software import SoftwareRenderer

    drawn = SoftwareRenderer(recording, height=size[0], width=size[1], color_by=color_by, surface=surface)
    threads = max(1, min(4, os.cpu_count() or 1))
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, recording.num_frames, 4 * threads):  # no more are kept than these
            yield from pool.map(drawn.render, range(first, min(first + 4 * threads, recording.num_frames)))


def _or_software(recording: Recording, size: tuple[int, int], color_by: str, backend: str) -> Iterator[np.ndarray]:
    """MuJoCo's pictures, and the other renderer's from where it failed."""
    from rewax.viz.opengl import mujoco_pictures

    done = 0
    try:
        for picture in mujoco_pictures(recording, size, color_by, backend):
            yield picture
            done += 1
    except OSError:  # the process that draws has ended
        yield from software_pictures(recording.take(range(done, recording.num_frames)), size, color_by)


__all__ = ["RENDERERS", "pictures", "software_pictures"]
