"""Sizes and colours of drawings, which may change during a recording."""

from typing import NamedTuple

import numpy as np

from rewax.viz.recording import Recording
from rewax.viz.shapes import KEYS, Drawing

_CONSTANT = frozenset(["center", "direction", "rotation", "vertices", "triangles"])
"""Keys of the pose, and those that are the same in all frames."""


class Look(NamedTuple):
    """A drawing while its size, colour and opacity stay the same."""

    number: int
    """Which of a frame's drawings it is."""
    drawing: Drawing
    """The drawing in the first of its frames."""
    shown: np.ndarray | None
    """In which frames it looks so, shape (num_frames,), bool; None: in all."""


def looks(recording: Recording) -> list[Look]:
    """The looks of all drawings but planes, in the order of the drawings and of the frames."""
    found = []
    for i, first in enumerate(recording.shapes(0)):
        if first["kind"] == "plane":
            continue
        drawings = [recording.shapes(frame)[i] for frame in range(recording.num_frames)]
        keys = [_key(drawing) for drawing in drawings]
        for key in dict.fromkeys(keys):
            shown = np.array([other == key for other in keys])
            found.append(Look(i, drawings[keys.index(key)], None if shown.all() else shown))
    return found


def _key(drawing: Drawing) -> tuple[str, ...]:
    """Text of the numbers that make a look, to three digits: rounding errors of a size are no other look."""
    names = [name for name in (*KEYS[drawing["kind"]], "color", "opacity") if name not in _CONSTANT]
    return tuple(
        f"{name} {number:.3g}"
        for name in names
        if name in drawing
        for number in np.asarray(drawing[name], float).reshape(-1)
    )


__all__ = ["Look", "looks"]
