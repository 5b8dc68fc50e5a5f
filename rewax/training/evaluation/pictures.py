"""The pictures, the video and the page of an episode; none of them can end a run."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from rewax.viz.recording import Recording


def attempt(path: Path, draw: Callable[[Path], str]) -> str:
    """Make a file; a run that has trained does not end with an exception over one.

    Args:
      path: of the file.
      draw: makes it, and returns what else there is to say, often nothing.

    Returns:
      A sentence: where it is, or why it is not.
    """
    try:
        more = draw(path)
    except Exception as error:  # an environment's own code is called, whole libraries and other programs
        return f"warning: {path.name} was not drawn ({reason(error)}); nothing else is affected"
    return f"wrote {path}{', ' if more else ''}{more}"


def reason(error: Exception) -> str:
    """What an exception says, on one line."""
    said = " ".join(str(error).split())[:200]
    return f"{type(error).__name__}: {said}"


def draw_strip(recording: Recording, out_png: Path, *, num_frames: int) -> str:
    """Some moments of an episode in one picture: particles with what moves among them, or rigid bodies alone."""
    from rewax.viz import bodies, plots  # matplotlib is slow to import

    shown = recording.subsample(num_frames)
    labels = [
        f"step {step}\nreturn {total:{'.0f' if abs(total) >= 100 else '.3g'}}"
        for step, total in zip(shown.steps, shown.totals, strict=True)
    ]
    shapes = [shown.shapes(i) for i in range(shown.num_frames)]
    if shown.particles is not None:
        plots.particle_strip(list(shown.particles), out_png, labels=labels, shapes=shapes)
    else:
        bodies.body_strip(shapes, out_png, labels=labels, up=np.asarray(shown.up))
    return ""


def draw_video(recording: Recording, out_mp4: Path, *, color_by: str = "material", surface: bool | None = None) -> str:
    """An episode as a video; returns how fast it plays."""
    from rewax.viz.video import record_video

    return record_video(recording, out_mp4, color_by=color_by, surface=surface)


def draw_page(recording: Recording, out_html: Path) -> str:
    """An episode as a page for a browser."""
    from rewax.viz.player import write_player

    write_player([recording], out_html, title=recording.name or "rewax")
    return ""


__all__ = ["attempt", "draw_page", "draw_strip", "draw_video", "reason"]
