"""Videos of recordings: MP4, encoded by the ffmpeg of imageio-ffmpeg."""

import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rewax.viz.recording import Recording, describe_speed, playback
from rewax.whole_files import replacing

SIZE = (360, 480)
"""Default height and width of a video [pixels]."""


def record_video(
    recording: Recording,
    out_mp4: str | Path,
    *,
    size: tuple[int, int] = SIZE,
    renderer: str = "auto",
    color_by: str = "material",
    surface: bool | None = None,
) -> str:
    """Draw a recording as a video.

    Args:
      recording: what to show.
      out_mp4: video to write.
      size: height and width of the scene in pixels, even numbers. What cameras show is added at its right.
      renderer, color_by, surface: as for ``rewax.viz.render.pictures``.

    Returns:
      The playback speed in words: ``in real time``, ``4 times slower than real time``.

    Raises:
      ValueError: the size is odd, or ``pictures`` raises.
      OSError: ffmpeg fails, or the file cannot be written.
    """
    from rewax.viz.beside import beside, pane_width
    from rewax.viz.render import pictures

    shown, rate, speed = playback(recording)
    drawn = pictures(shown, size=size, renderer=renderer, color_by=color_by, surface=surface)
    whole = (size[0], size[1] + pane_width(shown, size[0]))
    write_video(beside(shown, drawn, size[0]), out_mp4, rate=rate, size=whole)
    return describe_speed(shown, speed)


def write_video(frames: Iterable[np.ndarray], out_mp4: str | Path, *, rate: float, size: tuple[int, int]) -> Path:
    """Write pictures as MP4 (H.264), which browsers and phones play.

    Args:
      frames: uint8, shape (height, width, 3) each.
      out_mp4: video to write; missing folders are made. The file appears once it is complete.
      rate: frames per second, > 0.
      size: height and width in pixels, even numbers.

    Raises:
      ValueError: the size is odd or the rate is not positive.
      OSError: ffmpeg fails, or the file cannot be written.
    """
    height, width = size
    if height % 2 or width % 2 or min(size) < 2:
        raise ValueError(f"size is {height} x {width}: H.264 needs even numbers, from 2 on")
    if not rate > 0.0:
        raise ValueError(f"rate is {rate}: give frames per second, above 0")
    out = Path(out_mp4)
    with replacing(out) as unfinished:
        _encode(frames, unfinished, rate=rate, size=size)
    return out


def _encode(frames: Iterable[np.ndarray], out: Path, *, rate: float, size: tuple[int, int]) -> None:
    """Sends pictures to ffmpeg."""
    height, width = size
    command = [
        _ffmpeg(), "-y", "-loglevel", "error",
        "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{rate:.3f}", "-i", "-",
        "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-preset", "veryfast", "-movflags", "+faststart",
        "-f", "mp4", str(out.absolute()),  # a colon in a relative path would end the name of a protocol
    ]  # fmt: skip
    # In its own session ffmpeg does not receive Ctrl-C, so the file is completed.
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
    try:
        _feed(process, frames)
    finally:
        process.kill()
        process.wait()


def _feed(process: "subprocess.Popen[bytes]", frames: Iterable[np.ndarray]) -> None:
    assert process.stdin is not None
    try:
        for frame in frames:
            process.stdin.write(np.ascontiguousarray(frame).tobytes())
    except BrokenPipeError:  # ffmpeg died early; its error output follows
        pass
    _, output = process.communicate()
    if process.returncode:
        lines = output.decode(errors="replace").strip().splitlines() or ["nothing"]
        raise OSError(f"ffmpeg failed; it said: {lines[-1]}")


def _ffmpeg() -> str:
    """Path of ffmpeg: that of imageio-ffmpeg, or one that imageio-ffmpeg finds on the system."""
    import imageio_ffmpeg

    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        raise OSError("there is no ffmpeg: pip install --force-reinstall imageio-ffmpeg") from None


__all__ = ["SIZE", "record_video", "write_video"]
