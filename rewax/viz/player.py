"""Recordings as one HTML page that plays them in a browser, without a network."""

import base64
import html
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rewax.status import Status
from rewax.viz.camera import frame_recording
from rewax.viz.colors import SCALE, color_by, material_colors, shape_color, value_range
from rewax.viz.ground import grid_spacing
from rewax.viz.meshes import mesh, pose
from rewax.viz.recording import Recording, diameters, playback
from rewax.viz.shapes import side_view

MAX_RUNS = 8
"""Browsers draw no more scenes at once reliably."""
_ASPECT = 4 / 3
_ASSETS = Path(__file__).parent


def write_player(recordings: Sequence[Recording], out_html: str | Path, *, title: str = "rewax") -> Path:
    """Write a page that plays recordings side by side, on one clock and with one camera.

    Args:
      recordings: one to eight.
      out_html: page to write. It needs nothing but a browser with WebGL 2.
      title: of the page.

    Returns:
      The path written. Positions are kept in steps of 1/65535 of the box that a recording's particles move in, colours
      and values in steps of 1/255.

    Raises:
      ValueError: no recordings, or too many.
    """
    if not 1 <= len(recordings) <= MAX_RUNS:
        raise ValueError(f"a page plays 1 to {MAX_RUNS} recordings, not {len(recordings)}: give fewer of them")
    named = {by: None for recording in recordings if recording.particles is not None for by in color_by(recording)}
    data = {
        "runs": [_run(recording) for recording in recordings],
        "speed": min(playback(recording)[2] for recording in recordings),
        "colors": list(named),
        "status": [[bit.name, int(bit)] for bit in Status if bit],
    }
    script = "\n".join(_asset(f"player{part}.js") for part in ("_shaders", "_scene", ""))
    page = _asset("player.html")
    for name, text in (
        ("title", html.escape(title)),
        ("style", _asset("player.css")),
        ("script", script),
        ("data", json.dumps(data, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")),
    ):
        page = page.replace("{{" + name + "}}", text, 1)
    out = Path(out_html)
    out.write_text(page, encoding="utf-8")
    return out


def _run(recording: Recording) -> dict[str, Any]:
    """A recording as the page's scripts read it."""
    framing = frame_recording(recording, aspect=_ASPECT)
    side = side_view(recording.up)
    return {
        "name": recording.name,
        "times": _rounded(recording.times),
        "dt": recording.step_dt,
        "rewards": _rounded(recording.rewards),
        "status": np.asarray(recording.status, int).tolist(),
        "axes": [side.right.tolist(), side.towards.tolist(), np.asarray(side.up).tolist()],
        "targets": _rounded(framing.targets.reshape(-1)),
        "distance": framing.distance,
        "aspect": _ASPECT,
        "azimuth": float(np.radians(framing.azimuth)),
        "elevation": float(np.radians(framing.elevation)),
        "radius": framing.radius,
        "spacing": grid_spacing(framing.radius),
        "floor": framing.floor,
        "palette": np.round(SCALE, 3).tolist(),
        "solids": _solids(recording),
        "particles": None if recording.particles is None else _particles(recording),
    }


def _particles(recording: Recording) -> dict[str, Any]:
    cloud = np.asarray(recording.particles, np.float64)
    low, high = cloud.min(axis=(0, 1)), cloud.max(axis=(0, 1))
    size = np.maximum(high - low, 1e-9)
    materials = np.zeros(cloud.shape[1], int) if recording.materials is None else np.asarray(recording.materials)
    colors = material_colors(recording.material_names)[materials]
    return {
        "count": cloud.shape[1],
        "low": low.tolist(),
        "size": size.tolist(),
        "positions": _moving(np.round(65535.0 * (cloud - low) / size).astype(np.uint16)),
        "radii": _packed(0.5 * diameters(recording), np.float32),
        "colors": _packed(np.round(255.0 * colors), np.uint8),
        "heights": list(value_range(cloud @ np.asarray(recording.up, float))),
        "values": {name: _value(value) for name, value in recording.values.items()},
        "triangles": None if recording.triangles is None else _packed(recording.triangles, np.uint32),
    }


def _value(values: np.ndarray) -> dict[str, Any]:
    """A number of each particle, between the ends of its scale."""
    low, high = value_range(values)
    part = np.clip((values - low) / (high - low), 0.0, 1.0)
    return {"low": low, "high": high, "data": _moving(np.round(255.0 * part).astype(np.uint8))}


def _solids(recording: Recording) -> list[dict[str, Any]]:
    """Surfaces of the rigid shapes, as they are in the first frame, and where they are in every frame."""
    found = []
    for i, first in enumerate(recording.shapes(0)):
        if first["kind"] == "plane":
            continue
        surface, (color, opacity) = mesh(first), shape_color(first)
        poses = [np.concatenate(pose(recording.shapes(frame)[i])) for frame in range(recording.num_frames)]
        found.append(
            {
                "vertices": _packed(surface.vertices, np.float32),
                "normals": _packed(surface.normals, np.float32),
                "triangles": _packed(surface.triangles, np.uint32),
                "poses": _packed(np.stack(poses), np.float32),
                "color": _rounded(color),
                "opacity": opacity,
            }
        )
    return found


def _moving(frames: np.ndarray) -> dict[str, Any]:
    """Whole numbers of every frame as differences from the frame before, which deflate well; low bytes come first."""
    flat = frames.reshape(len(frames), -1)
    change = flat.copy()
    change[1:] -= flat[:-1]  # wraps around
    wide = frames.dtype == np.uint16
    planes = change.astype("<u2").reshape(-1).view(np.uint8).reshape(-1, 2).T if wide else change
    return {"z": _text(planes), "type": "u2" if wide else "u1", "frames": len(frames)}


def _packed(values: np.ndarray, dtype: Any) -> dict[str, Any]:
    array = np.ascontiguousarray(values, np.dtype(dtype).newbyteorder("<"))
    return {"z": _text(array), "type": {"f": "f4", "u": f"u{array.itemsize}"}[array.dtype.kind]}


def _text(array: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(np.ascontiguousarray(array).tobytes(), 6)).decode("ascii")


def _rounded(values: np.ndarray) -> list[float]:
    """Numbers with six digits."""
    return [float(f"{value:.6g}") for value in np.asarray(values, float).reshape(-1)]


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


__all__ = ["MAX_RUNS", "write_player"]
