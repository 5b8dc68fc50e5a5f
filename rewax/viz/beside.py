"""What cameras show beside the scene: panes at the right of each picture of a video."""

import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from rewax.viz.colors import SCALE
from rewax.viz.recording import Recording
from rewax.viz.seen import NOTHING, Seen

_CAPTION, _FOOT, _GAP = 20, 30, 8
_INK = (29, 39, 51)
_MOST = 3
"""So many pictures fit below each other; more of them stand in several panes."""


def pane_width(recording: Recording, height: int) -> int:
    """Width of all panes for a video of this height [pixels], an even number; 0 where nothing is seen."""
    return sum(_width(shown, height) for shown in _panes(recording))


def beside(recording: Recording, frames: Iterable[np.ndarray], height: int) -> Iterator[np.ndarray]:
    """The frames with what all cameras show at their right, in panes of at most three pictures.

    Args:
      recording: the frames are its frames.
      frames: uint8, shape (height, width, 3) each.
      height: of the frames [pixels].

    Returns:
      Pictures of shape (height, width + pane_width(recording, height), 3).
    """
    panes = _panes(recording)
    for i, frame in enumerate(frames):
        drawn = [_pane(shown, i, height, _width(shown, height)) for shown in panes]
        yield np.concatenate([frame, *drawn], axis=1) if drawn else frame


def _panes(recording: Recording) -> list[Sequence[Seen]]:
    """The pictures of each pane: as few panes as there can be, about equally full."""
    seen = recording.seen
    count = -(-len(seen) // _MOST)
    ends = [i * len(seen) // count for i in range(count + 1)] if count else []
    return [seen[start:end] for start, end in itertools.pairwise(ends)]


def _width(shown: Sequence[Seen], height: int) -> int:
    return max(_size(seen, height, len(shown))[1] for seen in shown) + 2 * _GAP


def _size(seen: Seen, height: int, count: int) -> tuple[int, int]:
    """Height and width of a picture in the pane [pixels], even numbers."""
    rows, columns = seen.pixels.shape[1:]
    most = min(height // count - _CAPTION - _FOOT, height // 2)
    factor = max(most, 2) / max(rows, columns)
    return max(2, 2 * int(0.5 * factor * rows)), max(2, 2 * int(0.5 * factor * columns))


def _pane(shown: Sequence[Seen], frame: int, height: int, width: int) -> np.ndarray:
    from PIL import Image, ImageDraw, ImageFont  # matplotlib brings it

    pane = Image.new("RGB", (width, height), (255, 255, 255))
    pen, font = ImageDraw.Draw(pane), ImageFont.load_default(11)
    for i, seen in enumerate(shown):
        top = i * (height // len(shown))
        rows, columns = _size(seen, height, len(shown))
        pen.text((_GAP, top + 4), seen.title, fill=_INK, font=font)
        picture = Image.fromarray(seen.picture(frame)).resize((columns, rows), Image.Resampling.NEAREST)
        pane.paste(picture, (_GAP, top + _CAPTION))
        below = top + _CAPTION + rows + 4
        if seen.kind == "depth":
            bar = np.stack([np.interp(np.linspace(0, len(SCALE) - 1, columns), range(len(SCALE)), c) for c in SCALE.T])
            pane.paste(Image.fromarray(np.round(255 * np.tile(bar.T, (7, 1, 1))).astype(np.uint8)), (_GAP, below))
            pen.text((_GAP, below + 8), f"{seen.near:.3g}", fill=_INK, font=font)
            pen.text((_GAP + columns, below + 8), f"{seen.far:.3g}", fill=_INK, font=font, anchor="ra")
        else:
            _legend(pen, font, seen, frame, below, width)
    return np.asarray(pane)


def _legend(pen: object, font: object, seen: Seen, frame: int, top: int, width: int) -> None:
    """Names of the bodies in the picture, each beside its colour, as many as fit into two lines."""
    x, y = _GAP, top
    for index in np.unique(seen.pixels[frame]):
        if index == NOTHING or index >= len(seen.names):
            continue
        name = str(seen.names[index])
        length = int(pen.textlength(name, font=font)) + 18  # type: ignore[attr-defined]
        if x > _GAP and x + length > width:
            x, y = _GAP, y + 13
        if y > top + 13:
            return
        color = tuple(int(c) for c in np.round(255 * seen.colors()[index]))
        pen.rectangle((x, y + 2, x + 8, y + 10), fill=color)  # type: ignore[attr-defined]
        pen.text((x + 12, y), name, fill=_INK, font=font)  # type: ignore[attr-defined]
        x += length


__all__ = ["beside", "pane_width"]
