"""Each of more than twenty bad records is refused in one sentence that names the fault and the remedy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import record_cases

import rewax
from rewax.envs.latency import Latency
from rewax.envs.sensing import Sensing
from rewax.identify.record_checks import check_against, check_record, tool_distance, tool_remarks
from rewax.identify.records import Record, load, save


def with_entry(name, index, value):
    def change(record):
        array = np.array(getattr(record, name))
        array[index] = value
        return {name: array}

    return change


BAD = {
    "not finite in times": (with_entry("times", 1, np.nan), "times of the record holds a number that is not finite"),
    "not finite in a cloud": (with_entry("clouds", (2, 5, 1), np.inf), "the cloud of frame 2 holds"),
    "not finite in actions": (with_entry("actions", 0, np.nan), "actions of the record holds"),
    "not finite in joints": (with_entry("joint_q", 1, np.nan), "joint_q of the record holds"),
    "times fall": (with_entry("times", 2, 0.01), "times do not rise"),
    "times stand": (with_entry("times", 2, 0.1), "times do not rise: 0.1 s, then 0.1 s"),
    "times before the start": (with_entry("times", 0, -0.1), "the first frame is at -0.1 s"),
    "frames after the last action": (with_entry("times", 4, 0.9), "the last frame is at 0.9 s, but 4 actions end at 0.4"),
    "no frame at rest": (lambda r: {"times": r.times + 0.2, "actions": np.ones((6, 2)), "joint_q": None}, "give a frame of the body at rest"),
    "an empty cloud": (with_entry("mask", 3, False), "frame 3 shows 0 points"),
    "millimetres": (lambda r: {"clouds": r.clouds * 1000.0}, "are they in millimetres"),
    "kilometres": (lambda r: {"clouds": r.clouds * 1e-4}, "no plausible body"),
    "other units": (lambda r: {"units": "mm,s"}, "convert to metres and seconds"),
    "another version": (lambda r: {"version": 2}, "version of the record is 2"),
    "one frame": (lambda r: {"times": r.times[:1], "clouds": r.clouds[:1], "mask": r.mask[:1]}, "has 1 frames: give at least 2"),
    "flat clouds": (lambda r: {"clouds": r.clouds[..., :2]}, "give .5, num_points, 3"),
    "clouds of fewer frames": (lambda r: {"clouds": r.clouds[:3]}, "with 5 times"),
    "a mask of another shape": (lambda r: {"mask": r.mask[:, :4]}, "give that of the clouds"),
    "a mask of numbers": (lambda r: {"mask": r.mask.astype(float)}, "give booleans"),
    "actions without an axis": (lambda r: {"actions": r.actions[:, 0]}, "actions of the record has shape .4,.: give 2 axes"),
    "joints of another length": (lambda r: {"joint_q": r.joint_q[:2]}, "give one before the first action"),
    "a control step of zero": (lambda r: {"control_dt": 0.0}, "must be positive"),
    "a camera of another shape": (lambda r: {"camera": np.zeros(12)}, "give 15 numbers"),
    "times of text": (lambda r: {"times": np.array(list("abcde"))}, "give real numbers"),
    "complex times": (lambda r: {"times": r.times + 0j}, "times of the record is of type complex128: give real numbers"),
    "a camera of text": (lambda r: {"camera": np.array(list("abcdefghijklmno"))}, "camera of .* give real numbers"),
    "a control step of text": (lambda r: {"control_dt": "a"}, "control_dt of the record is 'a', which is no real number"),
    "no control step": (lambda r: {"control_dt": None}, "control_dt of the record is None, but must be positive: give the"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_record_is_refused_in_one_sentence(fault):
    change, sentence = BAD[fault]
    record = record_cases.pushed()
    check_record(record)
    with pytest.raises(ValueError, match=sentence) as refusal:
        check_record(dataclasses.replace(record, **change(record)))
    assert "\n" not in str(refusal.value)


def test_what_is_no_record_is_refused():
    with pytest.raises(ValueError, match=r"^record is None: give a Record, load\(path\) for example$"):
        check_record(None)


AGAINST = {
    "other actions": (lambda r: {"actions": np.zeros((4, 5))}, "takes .2,. each"),
    "another control step": (lambda r: {"control_dt": 0.2}, "control_dt of the record is 0.2 s"),
    "a tool that rests": (lambda r: {"actions": 0 * r.actions, "joint_q": 0 * r.joint_q}, "the tool does not move"),
    "another place": (lambda r: {"clouds": r.clouds + 10.0}, "give both in one frame"),
    "a tool that never touches": (lambda r: {"joint_q": r.joint_q + 2.0}, "the tool never touches: it stays"),
}  # fmt: skip


@pytest.mark.parametrize("fault", AGAINST)
def test_a_record_that_does_not_fit_the_environment_is_refused(fault):
    change, sentence = AGAINST[fault]
    record, env = record_cases.pushed(), record_cases.pusher()
    particles = record_cases.body()
    check_against(record, env, particles)
    with pytest.raises(ValueError, match=sentence):
        check_against(dataclasses.replace(record, **change(record)), env, particles)


PATHS = [
    (lambda r: {}, lambda e: {"joint_lower": e.joint_start - 0.006}, "after 2 steps .* tool 0.002 away"),
    (lambda r: {}, lambda e: {"joint_step": 2.0 * e.joint_step}, "after 1 steps .* tool 0.004 away"),
    (lambda r: {"joint_q": r.joint_q + 0.1}, lambda e: {}, "after 0 steps .* tool 0.1 away from joint_q"),
    (lambda r: {"joint_q": r.joint_q[:, :2]}, lambda e: {}, "joint_q has shape .4, 2.: give one number for"),
]
"""Changes of the record and of the environment, and what is said."""


def test_a_record_of_another_path_of_the_tool_is_refused():
    """The pin of RollingFlat goes down by 4 mm in each of three steps."""
    env = rewax.make("RollingFlat", scale="small").replace(joint_step=jnp.array([0.004, 0.004, 0.004]))
    particles, actions = np.asarray(env.rest_positions), np.tile([0.0, -2.0, 0.0], (3, 1))  # beyond -1: as -1
    record = Record(
        times=env.control_dt * np.arange(4), clouds=np.tile(particles, (4, 1, 1)), mask=np.ones((4, len(particles)), bool),
        actions=actions, control_dt=float(env.control_dt),
        joint_q=np.asarray(env.joint_start) - 0.004 * np.arange(4)[:, None] * np.array([0.0, 1.0, 0.0]),
    )  # fmt: skip
    check_against(record, Sensing(env=env), particles)
    for of_record, of_env, sentence in PATHS:
        other = dataclasses.replace(record, **of_record(record))
        with pytest.raises(ValueError, match=sentence):
            check_against(other, env.replace(**of_env(env)), particles)
    faster = env.replace(joint_step=2.0 * env.joint_step)
    check_against(record, Latency(env=faster, action=1), particles)  # acts one step later


def test_the_distance_of_the_tool_is_that_of_its_surface():
    record, env = record_cases.pushed(), record_cases.pusher()
    points = record.clouds[np.arange(5)[:, None], np.arange(record.clouds.shape[1])]
    steps = np.round(record.times / record.control_dt).astype(int)
    centers = np.stack([record.joint_q[steps, 0], record.joint_q[steps, 1], np.zeros(5)], -1)
    gap = np.linalg.norm(points - centers[:, None], axis=-1) - 0.1
    still = dataclasses.replace(record, joint_q=np.tile(record.joint_q[:1], (len(record.joint_q), 1)))
    first = np.linalg.norm(points - centers[0], axis=-1) - 0.1
    assert tool_distance(still, env) == pytest.approx(first[record.mask].min(), abs=1e-6)
    assert tool_distance(record, env) <= gap[record.mask].min() + 1e-6


def test_a_touch_between_two_frames_counts():
    """The tool is at the body in one step alone, which no frame shows."""
    every, env = record_cases.pushed(), record_cases.pusher()
    record = dataclasses.replace(every, times=every.times[::2], clouds=every.clouds[::2], mask=every.mask[::2])
    assert 1 not in np.round(record.frame_steps)
    away = np.full_like(record.joint_q, 5.0)
    away[1] = record.joint_q[1]
    near = tool_distance(dataclasses.replace(record, joint_q=away), env)
    assert near < 1.0 < tool_distance(dataclasses.replace(record, joint_q=np.full_like(away, 5.0)), env)


def test_files_that_are_no_records_are_refused(tmp_path):
    with pytest.raises(ValueError, match="there is no record"):
        load(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("no record")
    with pytest.raises(ValueError, match="is no npz file"):
        load(tmp_path / "text.npz")
    np.savez(tmp_path / "part.npz", times=np.zeros(3))
    with pytest.raises(ValueError, match="lacks version, units, clouds"):
        load(tmp_path / "part.npz")
    np.savez(tmp_path / "objects.npz", times=np.array([{}], object))
    with pytest.raises(ValueError, match="holds objects"):
        load(tmp_path / "objects.npz")
    with pytest.raises(ValueError, match="version of the record is 3"):
        save(dataclasses.replace(record_cases.pushed(), version=3), tmp_path / "a.npz")


def test_a_tool_that_the_body_sinks_into_is_told():
    env = rewax.make("RollingFlat", scale="small")
    (said,) = tool_remarks(env)
    assert "reaches 3.5 mm and a cell of the grid is 42 mm" in said
    pins = tuple(pin.replace(softness=np.log(10.0) / env.scene.grid.spacing) for pin in env.scene.colliders)
    assert tool_remarks(env.replace(scene=env.scene.replace(colliders=pins))) == []
    assert tool_remarks(record_cases.pusher()) == [] == tool_remarks(object())
