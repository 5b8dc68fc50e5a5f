"""What a camera of an environment showed, frame by frame, as small pictures of bytes."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from rewax.viz.colors import SCALE

LARGEST_SIDE = 128
"""Recorded pictures have at most this many pixels a side; of larger ones every second pixel is kept, or every third."""
NOTHING = 255
"""The byte of a pixel that sees nothing."""
BACKGROUND = (0.90, 0.92, 0.94)
"""Colour of pixels that see nothing."""
LABELS = np.array(
    [[0.68, 0.71, 0.76], [0.17, 0.42, 0.69], [0.89, 0.62, 0.34], [0.18, 0.52, 0.35], [0.50, 0.35, 0.84],
     [0.72, 0.20, 0.50], [0.10, 0.60, 0.62], [0.77, 0.34, 0.10], [0.45, 0.45, 0.15], [0.30, 0.34, 0.41]]
)  # fmt: skip
"""Colours of bodies, in the order of their labels; they repeat."""


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """A camera's pictures of an episode.

    Attributes:
      name: of the observation.
      kind: ``depth``: bytes from 0 at ``near`` to 254 at ``far``, as observed, with noise and latency. ``bodies``: a
        byte is the index of a body in ``names``, as the camera sees it now, without noise. ``NOTHING`` (255) in both.
      pixels: uint8, shape (num_frames, height, width).
      near, far: ends of the scale of depth [m].
      names: of the bodies.
    """

    name: str
    kind: Literal["depth", "bodies"]
    pixels: np.ndarray
    near: float = 0.0
    far: float = 1.0
    names: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.pixels.dtype != np.uint8 or self.pixels.ndim != 3 or max(self.pixels.shape[1:]) > LARGEST_SIDE:
            raise ValueError(
                f"pixels of {self.name} are {self.pixels.dtype} of shape {self.pixels.shape}: give uint8 of shape "
                f"(num_frames, height, width), with at most {LARGEST_SIDE} pixels a side"
            )

    @property
    def title(self) -> str:
        """``depth [m]``, ``depth: bodies``."""
        return f"{self.name} [m]" if self.kind == "depth" else f"{self.name}: bodies"

    def take(self, frames: np.ndarray) -> "Seen":
        """Some of the frames."""
        return dataclasses.replace(self, pixels=self.pixels[frames])

    def colors(self) -> np.ndarray:
        """The colour of each byte, shape (256, 3), between 0 and 1."""
        if self.kind == "bodies":
            table = LABELS[np.arange(256) % len(LABELS)]
        else:
            place = np.linspace(0.0, len(SCALE) - 1.0, NOTHING)
            table = np.stack([np.interp(place, np.arange(len(SCALE)), SCALE[:, i]) for i in range(3)], axis=-1)
        return np.concatenate([table[:NOTHING], [BACKGROUND]])

    def picture(self, frame: int) -> np.ndarray:
        """A frame in colours, uint8, shape (height, width, 3)."""
        return np.round(255.0 * self.colors()).astype(np.uint8)[self.pixels[frame]]


def stride(height: int, width: int) -> int:
    """Every how many-th pixel of a picture is recorded, along both axes."""
    return -(-max(height, width) // LARGEST_SIDE)


__all__ = ["BACKGROUND", "LABELS", "LARGEST_SIDE", "NOTHING", "Seen", "stride"]
