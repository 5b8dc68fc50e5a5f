"""Videos of recordings: MP4 through ffmpeg, which comes with imageio-ffmpeg."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rewax.viz.recording import Recording, describe_speed, playback

SIZE = (360, 480)
"""Height and width of a video in pixels."""


def record_video(
    recording: Recording,
    out_mp4: str | Path,
    *,
    size: tuple[int, int] = SIZE,
    renderer: str = "auto",
    color_by: str = "material",
) -> str:
    """Draw a recording as a video.

    Args:
      recording: what to show.
      out_mp4: video to write.
      size: height and width in pixels, even numbers.
      renderer, color_by: as for ``rewax.viz.render.pictures``.

    Returns:
      How fast it plays: ``in real time``, ``4 times slower than real time``.

    Raises:
      ValueError: an odd size, an unknown renderer, or nothing of the name ``color_by``.
      OSError: ffmpeg or the file fails.
    """
    from rewax.viz.render import pictures

    shown, rate, speed = playback(recording)
    write_video(pictures(shown, size=size, renderer=renderer, color_by=color_by), out_mp4, rate=rate, size=size)
    return describe_speed(shown, speed)


def write_video(frames: Iterable[np.ndarray], out_mp4: str | Path, *, rate: float, size: tuple[int, int]) -> Path:
    """Write pictures as MP4 (H.264), which browsers and phones play.

    Args:
      frames: uint8, shape (height, width, 3) each.
      out_mp4: video to write; it appears when it is complete.
      rate: frames per second, > 0.
      size: height and width in pixels, even numbers.

    Raises:
      ValueError: an odd size or a rate that is not positive.
      OSError: ffmpeg or the file fails.
    """
    import imageio_ffmpeg

    height, width = size
    if height % 2 or width % 2 or min(size) < 2:
        raise ValueError(f"size is {height} x {width}: H.264 needs even numbers, from 2 on")
    if not rate > 0.0:
        raise ValueError(f"rate is {rate}: give frames per second, above 0")
    out = Path(out_mp4)
    unfinished = out.with_name(f".{out.stem}.writing.mp4")
    writer = imageio_ffmpeg.write_frames(
        str(unfinished),
        (width, height),
        fps=round(rate, 3),
        codec="libx264",
        quality=None,
        macro_block_size=1,
        output_params=["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"],
        ffmpeg_log_level="error",
    )
    try:
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))
        writer.close()
        unfinished.replace(out)
    finally:
        writer.close()
        unfinished.unlink(missing_ok=True)
    return out


__all__ = ["SIZE", "record_video", "write_video"]
