"""Pictures drawn one by one, while an episode goes on: a camera that stands still as long as it can."""

import dataclasses

import numpy as np

from rewax.viz.camera import Framing, boxes_of, frame_boxes, in_picture
from rewax.viz.recording import Recording
from rewax.viz.skin import skinned
from rewax.viz.software import SoftwareRenderer
from rewax.viz.surface import has_surfaces

_ROOM = 1.25
"""The eye stands farther away than it must by this factor, so that it seldom has to move."""


class SteadyPictures:
    """Draws the states of one episode, in their order.

    The camera stands still until something leaves its picture. Then it moves to where it shows this state and all those
    at which it has moved before. Once things have travelled far, it goes with them, unless the recording's ``camera``
    says otherwise.

    Args:
      size: height and width of a picture in pixels.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size, self._aspect = size, size[1] / size[0]
        self._boxes = np.zeros((0, 2, 3))
        self._framing: Framing | None = None

    def draw(self, recording: Recording) -> np.ndarray:
        """A picture of a recording of one frame, drawn with NumPy, uint8 of shape (height, width, 3)."""
        recording = skinned(recording)
        height, width = self._size
        renderer = SoftwareRenderer(
            recording, height=height, width=width, surface=has_surfaces(recording), framing=self.frame(recording)
        )
        return renderer.render(0)

    def frame(self, recording: Recording) -> Framing:
        """Where the camera stands for a recording of one frame."""
        box = boxes_of(recording)
        if self._framing is not None:
            framing = _at(self._framing, box)
            if in_picture(framing, recording, box, self._aspect):
                return framing
        self._boxes = np.concatenate([self._boxes, box])
        framing = frame_boxes(recording, self._boxes, self._aspect)
        self._framing = _at(
            dataclasses.replace(
                framing,
                targets=framing.targets[-1:],
                distance=_ROOM * framing.distance,
                radius=_ROOM * framing.radius,
            ),
            box,
        )
        return self._framing


def _at(framing: Framing, box: np.ndarray) -> Framing:
    """The same camera; one that follows looks at the middle of the box."""
    return dataclasses.replace(framing, targets=box.mean(axis=1)) if framing.follow else framing


__all__ = ["SteadyPictures"]
