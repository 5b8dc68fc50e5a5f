"""Drawings that change size or colour during a recording."""

import numpy as np
import recordings

from rewax.viz.looks import looks

GROUND = {"kind": "plane", "center": np.zeros(3), "direction": (0.0, 1.0, 0.0)}


def ball(frame, **options):
    return {"kind": "sphere", "center": np.array([0.1 * frame, 0.0, 0.0]), "radius": 0.1, **options}


def test_a_drawing_that_only_moves_has_one_look():
    recording = recordings.made(5, drawings=[[GROUND, ball(i, radius=0.1 + 1e-8 * i)] for i in range(5)])
    (only,) = looks(recording)
    assert only.number == 1 and only.shown is None


def test_each_size_and_colour_has_its_frames():
    drawings = [[ball(0)], [ball(1, color=(0.0, 1.0, 0.0))], [ball(2, radius=0.3)], [ball(3)]]
    found = looks(recordings.made(4, drawings=drawings))
    assert [look.shown.tolist() for look in found] == [
        [True, False, False, True], [False, True, False, False], [False, False, True, False]
    ]  # fmt: skip
    assert [look.drawing["radius"] for look in found] == [0.1, 0.1, 0.3]
    assert {look.number for look in found} == {0}
