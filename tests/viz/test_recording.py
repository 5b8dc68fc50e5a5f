"""Recordings know their times and totals, and play as fast as they say."""

import numpy as np
import pytest
import recordings

from rewax.viz.recording import describe_speed, diameters, playback


def test_times_and_totals_are_those_of_the_frames():
    recording = recordings.moving_ball(
        5, steps=np.array([0, 2, 4, 6, 7]), rewards=np.arange(7.0), status=np.zeros(7, int)
    )
    np.testing.assert_allclose(recording.times, [0.0, 0.04, 0.08, 0.12, 0.14])
    np.testing.assert_array_equal(recording.totals, [0.0, 1.0, 6.0, 15.0, 21.0])
    some = recording.take([0, 4])
    np.testing.assert_array_equal(some.totals, [0.0, 21.0])
    assert recording.subsample(3).steps.tolist() == [0, 4, 7] and recording.subsample(99).num_frames == 5


@pytest.mark.parametrize(
    ("num_frames", "dt", "rate", "speed", "said"),
    [
        (301, 0.02, 25.0, 1.0, "in real time"),  # 6 s, every second frame
        (302, 0.02, 25.0, 1.0, "in real time"),  # and the last one
        (301, 1 / 60, 30.0, 1.0, "in real time"),
        (61, 0.02, 50 / 3, 1 / 3, "3 times slower than real time"),
        (61, 0.007, 1 / 0.056, 1 / 8, "8 times slower than real time"),
        (6, 0.5, 10 / 5, 1.0, "2 times slower than real time"),
        (101, None, 25.0, 1.0, "25 steps per second"),
        (5, 0.02, 10.0, 1 / 5, "5 times slower than real time"),
    ],
)  # fmt: skip
def test_videos_last_as_long_as_is_said(num_frames, dt, rate, speed, said):
    recording = recordings.moving_ball(num_frames, control_dt=dt)
    shown, found_rate, found_speed = playback(recording)
    if num_frames == 6:  # fewer frames than ten a second: real time
        assert (found_rate, found_speed) == (2.0, 1.0)
        return
    assert found_rate == pytest.approx(rate) and found_speed == pytest.approx(speed)
    assert found_rate <= 30.0 + 1e-6
    assert shown.steps[0] == 0 and shown.steps[-1] == num_frames - 1 and np.all(np.diff(shown.steps) > 0)
    duration = (shown.num_frames - 1) / found_rate
    assert duration == pytest.approx((num_frames - 1) * (dt or 0.04) / found_speed, rel=0.01)
    assert describe_speed(shown, found_speed) == said


def test_spheres_of_a_lattice_touch_and_each_material_has_its_own():
    axis = np.arange(6) * 0.1
    coarse = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    fine = 0.5 * coarse + 2.0
    points = np.concatenate([coarse, fine])[None]
    materials = np.repeat([0, 1], len(coarse))
    found = diameters(recordings.cloud(1, particles=points, materials=materials, values={}))
    assert np.ptp(found[materials == 0]) == 0.0
    np.testing.assert_allclose(found[0], 0.1, rtol=0.25)
    np.testing.assert_allclose(found[-1], 0.05, rtol=0.25)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"status": np.zeros(3, int)}, r"status has shape \(3,\): give one number for each of 4 rewards"),
        ({"rewards": np.ones(3)}, r"status has shape \(4,\): give one number for each of 3 rewards"),
        ({"actions": np.ones(4)}, r"actions has shape \(4,\): give one row for each of 4 rewards"),
        ({"metrics": {"mass": np.ones(5)}}, r"the metric mass has shape \(5,\): give one number for each of 4 rewards"),
        ({"particles": np.zeros((4, 60, 3))}, "particles has 4 frames, not 5: give one for each"),
        ({"drawings": [[recordings.BALL]] * 6}, "drawings has 6 frames, not 5: give one for each"),
        (
            {"values": {"speed": np.zeros((60, 5))}},
            r"the value speed has shape \(60, 5\): give a number for each of 5 frames and 60 particles",
        ),
        ({"triangles": np.zeros((2, 2), int)}, r"triangles has shape \(2, 2\): give 3 indices of particles in a row"),
        ({"triangles": np.array([[0, 1, 60]])}, "triangles has an index that is none of the 60 particles"),
        ({"segments": np.array([[-1, 1]])}, "segments has an index that is none of the 60 particles"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        recordings.cloud(5, **options)


def test_rewards_may_be_missing():
    without = recordings.cloud(3, rewards=np.zeros(0), status=np.zeros(0, int))
    assert without.num_frames == 3 and without.totals.tolist() == [0.0] * 3


def test_what_cannot_be_shown_is_refused():
    with pytest.raises(ValueError, match="nothing to show: give the environment particles or render_shapes"):
        recordings.made(3)
    with pytest.raises(ValueError, match="nothing to show"):
        recordings.made(2, drawings=[recordings.moving_ball().drawings[0][:1]] * 2)
    with pytest.raises(ValueError, match="other kinds of drawings in some frames"):
        recordings.made(2, drawings=[[recordings.BALL], []])
    body = {
        "kind": "mesh",
        "center": np.zeros(3),
        "vertices": np.eye(4, 3),
        "triangles": [(0, 1, 2)],
        "rotation": np.eye(3),
    }
    recordings.made(2, drawings=[[body], [{**body, "center": np.ones(3), "vertices": np.eye(4, 3)}]])
    for changed in ({"vertices": 2.0 * np.eye(4, 3)}, {"triangles": [(0, 2, 1)]}):
        with pytest.raises(
            ValueError, match="drawing 1 is a mesh that changes: give the same vertices and triangles always"
        ):
            recordings.made(2, drawings=[[recordings.BALL, body], [recordings.BALL, {**body, **changed}]])
    with pytest.raises(ValueError, match=r"opacity of the drawing of a sphere is 2\.0: give numbers from 0 to 1"):
        recordings.made(1, drawings=[[{**recordings.BALL, "opacity": 2.0}]])
    with pytest.raises(ValueError, match=r"materials has shape \(3,\): give one index for each of 60 particles"):
        recordings.cloud(2, materials=np.zeros(3, int))
    with pytest.raises(ValueError, match="materials has an index beyond the 1 material_names: give a name for each"):
        recordings.cloud(2, materials=np.ones(60, int), material_names=("dough",))
    with pytest.raises(ValueError, match="a recording has no frames"):
        recordings.made(1, steps=np.zeros(0, int), particles=np.zeros((0, 4, 3)))
