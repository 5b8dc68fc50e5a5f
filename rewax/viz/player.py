"""Recordings as one HTML page that plays them in a browser, without a network."""

import base64
import html
import json
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rewax.status import Status
from rewax.viz.camera import Framing, frame_both
from rewax.viz.colors import SCALE, color_by, material_colors, named_values, renamed, shape_color, value_range
from rewax.viz.ground import grid_spacing
from rewax.viz.looks import looks
from rewax.viz.meshes import mesh, pose
from rewax.viz.recording import Recording, diameters, playback
from rewax.viz.seen import Seen
from rewax.viz.shapes import side_view
from rewax.viz.skin import skinned
from rewax.whole_files import replacing

MAX_RUNS = 8
"""Browsers draw no more WebGL canvases at once reliably."""
CURVES = ("reward", "return", "actions")
"""Names of the page's own curves; a page without actions offers the first two. Metrics follow."""
_ASPECT = 4 / 3
_ASSETS = Path(__file__).parent
SCRIPTS = (
    "player_data.js", "player_gl.js", "player_shaders.js", "player_surface.js", "player_cloud.js", "player_scene.js",
    "player_curves.js", "player_seen.js", "player_camera.js", "player_capture.js", "player_controls.js", "player.js",
)  # fmt: skip
"""Scripts of the page, in the order in which they are read."""


def write_player(recordings: Sequence[Recording], out_html: str | Path, *, title: str = "rewax") -> Path:
    """Write a page that plays recordings side by side, on one clock and with one camera.

    Args:
      recordings: one to eight.
      out_html: page to write. It needs a browser with WebGL 2 and no network.
      title: of the page.

    Returns:
      The path written. The page keeps positions in steps of 1/65535 of the box that a recording's particles move in,
      and colours and values in steps of 1/255. The browser computes surfaces of particles (``player_surface.js``).

    Raises:
      ValueError: no recordings, or too many.
    """
    if not 1 <= len(recordings) <= MAX_RUNS:
        raise ValueError(f"a page plays 1 to {MAX_RUNS} recordings, not {len(recordings)}: give fewer of them")
    data = {
        "runs": [_run(recording) for recording in recordings],
        "speed": min(playback(recording)[2] for recording in recordings),
        "colors": list(dict.fromkeys(by for r in recordings if r.particles is not None for by in color_by(r))),
        "status": [[bit.name, int(bit)] for bit in Status if bit],
    }
    parts = {
        "title": html.escape(title),
        "style": _asset("player.css"),
        "script": "\n".join(map(_asset, SCRIPTS)),
        "data": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
    }
    page = re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _asset("player.html"))
    out = Path(out_html)
    with replacing(out) as unfinished:
        unfinished.write_text(page, encoding="utf-8", errors="replace")  # names of files may not be UTF-8
    return out


def _run(recording: Recording) -> dict[str, Any]:
    """A recording as the page's scripts read it."""
    recording = skinned(recording)
    followed, still, follow = frame_both(recording, aspect=_ASPECT)
    chosen, side = followed if follow else still, side_view(recording.up)
    actions = np.zeros((0, 0)) if recording.actions is None else np.asarray(recording.actions)
    return {
        "name": recording.name,
        "times": recording.times.tolist(),  # not rounded: a step is over once its time is reached
        "dt": recording.step_dt,
        "rewards": _rounded(np.nan_to_num(recording.rewards)),  # JSON has no NaN
        "actions": _packed(actions, np.float32),
        "num_actions": actions.shape[1],
        "metrics": {
            name: _packed(values, np.float32)
            for name, values in zip(renamed(recording.metrics, CURVES), recording.metrics.values(), strict=True)
        },
        "status": np.asarray(recording.status, int).tolist(),
        "axes": [side.right.tolist(), side.towards.tolist(), np.asarray(side.up).tolist()],
        "follow": follow,
        "followed": _framing(followed, followed.targets),
        "still": _framing(still, still.targets[0]),
        "aspect": _ASPECT,
        "azimuth": float(np.radians(chosen.azimuth)),
        "elevation": float(np.radians(chosen.elevation)),
        "floor": chosen.floor,
        "palette": np.round(SCALE, 3).tolist(),
        "solids": _solids(recording),
        "seen": [_seen(seen) for seen in recording.seen],
        "particles": None if recording.particles is None else _particles(recording),
    }


def _framing(framing: Framing, targets: np.ndarray) -> dict[str, Any]:
    """Where the camera looks, from how far, and the floor that it then sees."""
    return {
        "targets": _rounded(targets),
        "distance": framing.distance,
        "radius": framing.radius,
        "spacing": grid_spacing(framing.radius),
    }


def _particles(recording: Recording) -> dict[str, Any]:
    cloud = np.asarray(recording.particles, np.float64)
    low, high = cloud.min(axis=(0, 1)), cloud.max(axis=(0, 1))
    size = np.maximum(high - low, 1e-9)
    materials = np.zeros(cloud.shape[1], int) if recording.materials is None else np.asarray(recording.materials)
    colors, sizes = material_colors(recording.material_names), diameters(recording)
    members = {int(material): np.flatnonzero(materials == material) for material in np.unique(materials)}
    return {
        "count": cloud.shape[1],
        "low": low.tolist(),
        "size": size.tolist(),
        "positions": _moving(np.round(65535.0 * (cloud - low) / size).astype(np.uint16)),
        "radii": _packed(0.5 * sizes, np.float32),
        "colors": _packed(np.round(255.0 * colors[materials]), np.uint8),
        "parts": [
            {"members": _packed(some, np.uint32), "diameter": float(sizes[some].mean()), "color": _rounded(colors[i])}
            for i, some in members.items()
        ],
        "heights": list(value_range(cloud @ np.asarray(recording.up, float))),
        "values": {name: _value(value) for name, value in named_values(recording).items()},
        "triangles": None if recording.triangles is None else _packed(recording.triangles, np.uint32),
    }


def _value(values: np.ndarray) -> dict[str, Any]:
    """A value of each particle in each frame, as a fraction of the range from ``low`` to ``high``."""
    low, high = value_range(values)
    part = np.clip((np.nan_to_num(values, nan=low) - low) / (high - low), 0.0, 1.0)
    return {"low": low, "high": high, "data": _moving(np.round(255.0 * part).astype(np.uint8))}


def _solids(recording: Recording) -> list[dict[str, Any]]:
    """Meshes of the rigid shapes in their own frames, their poses in every frame, and the frames that show them."""
    solids = []
    for look in looks(recording):
        surface, (color, opacity) = mesh(look.drawing), shape_color(look.drawing)
        poses = [np.concatenate(pose(recording.shapes(frame)[look.number])) for frame in range(recording.num_frames)]
        solids.append(
            {
                "vertices": _packed(surface.vertices, np.float32),
                "normals": _packed(surface.normals, np.float32),
                "triangles": _packed(surface.triangles, np.uint32),
                "poses": _packed(np.stack(poses), np.float32),
                "color": _rounded(color),
                "opacity": opacity,
                "shown": None if look.shown is None else _packed(look.shown, np.uint8),
            }
        )
    return solids


def _seen(seen: Seen) -> dict[str, Any]:
    """Pictures of a camera, and the colours of their bytes."""
    return {
        "title": seen.title,
        "height": seen.pixels.shape[1],
        "width": seen.pixels.shape[2],
        "near": seen.near,
        "far": seen.far,
        "names": list(seen.names),
        "colors": np.round(255.0 * seen.colors()).astype(int).reshape(-1).tolist(),
        "pixels": _moving(seen.pixels),
    }


def _moving(frames: np.ndarray) -> dict[str, Any]:
    """Integers of every frame as differences from the frame before, which deflate well; all low bytes come first."""
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
    """Numbers rounded to six digits."""
    return [float(f"{value:.6g}") for value in np.asarray(values, float).reshape(-1)]


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


__all__ = ["MAX_RUNS", "SCRIPTS", "write_player"]
