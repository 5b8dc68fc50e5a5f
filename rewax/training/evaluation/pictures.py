"""Pictures, video and page of an episode; an error in one of them does not end a run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rewax.viz.recording import Recording


def attempt(path: Path, draw: Callable[[Path], str]) -> str:
    """Draw a file; an exception becomes a sentence.

    Args:
      path: of the file.
      draw: draws it, and returns a remark or an empty string.

    Returns:
      A sentence: the path, or why the file was not drawn.
    """
    try:
        more = draw(path)
    except Exception as error:  # the environment's code, libraries and other programs
        return f"warning: {path.name} was not drawn ({reason(error)}); nothing else is affected"
    return f"wrote {path}{', ' if more else ''}{more}"


def reason(error: Exception) -> str:
    """Type and message of an exception on one line."""
    message = " ".join(str(error).split())[:200]
    return f"{type(error).__name__}: {message}"


def draw_strip(recording: Recording, out_png: Path, *, num_frames: int) -> str:
    """Some moments of an episode in one picture: particles and bodies, or rigid bodies alone."""
    from rewax.viz import bodies, plots  # matplotlib is slow to import

    shown = recording.subsample(num_frames)
    labels = [
        f"step {step}\nreturn {total:{'.0f' if abs(total) >= 100 else '.3g'}}"
        for step, total in zip(shown.steps, shown.totals, strict=True)
    ]
    shapes = [shown.shapes(i) for i in range(shown.num_frames)]
    if shown.particles is not None:
        diameter = None if shown.thickness is None else 3.0 * shown.thickness  # sheets and lines have no volume
        plots.particle_strip(
            list(shown.particles), out_png, labels=labels, shapes=shapes, diameter=diameter, up=shown.up
        )
    else:
        bodies.body_strip(shapes, out_png, labels=labels, up=np.asarray(shown.up))
    return ""


def draw_video(recording: Recording, out_mp4: Path, **options: Any) -> str:
    """Draw an episode as a video; returns its speed of play. For options see ``rewax.viz.video.record_video``."""
    from rewax.viz.video import record_video

    return record_video(recording, out_mp4, **options)


def draw_page(recording: Recording, out_html: Path) -> str:
    """Write an episode as a page for a browser."""
    from rewax.viz.player import write_player

    write_player([recording], out_html, title=recording.name or "rewax")
    return ""


__all__ = ["attempt", "draw_page", "draw_strip", "draw_video", "reason"]
