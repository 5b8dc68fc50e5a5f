"""PLY files and a CSV path become the record that they were written from; faults are told in a sentence."""

from types import SimpleNamespace

import numpy as np
import pytest
import record_cases

import rewax
from rewax.identify.readers import actions_of, read_folder

trimesh = pytest.importorskip("trimesh", reason="pip install 'rewax[meshes]'")
ENV = SimpleNamespace(
    control_dt=0.1, joint_start=np.array([-0.1, 0.0]), joint_step=np.array([0.01, 0.01]),
    joint_lower=np.array([-0.11, -1.0]), joint_upper=np.array([0.2, 0.1]),
)  # fmt: skip


def write(folder, record, unit=1.0):
    for time, cloud, mask in zip(record.times, record.clouds, record.mask, strict=True):
        trimesh.PointCloud(cloud[mask] / unit).export(folder / f"cloud_{round(time * 1e6):08d}.ply")
    rows = [f"{0.1 * i:.6f},{q[0]:.6f},{q[1]:.6f}" for i, q in enumerate(record.joint_q)]
    (folder / "tool.csv").write_text("\n".join(["time,x,y", *rows]) + "\n")
    return folder / "tool.csv"


@pytest.mark.parametrize("unit", [1.0, 0.001])
def test_what_was_written_is_read(tmp_path, unit):
    record = record_cases.pushed()
    tool = write(tmp_path, record, unit)
    read = read_folder(tmp_path, tool, ENV, num_points=30, scale=unit)
    np.testing.assert_allclose(read.times, record.times)
    np.testing.assert_allclose(read.joint_q, record.joint_q, atol=1e-6)
    np.testing.assert_allclose(read.actions, np.tile([1.0, 0.0], (4, 1)), atol=1e-4)
    assert read.mask.sum(1).tolist() == [26] * 5
    np.testing.assert_allclose(read.clouds[:, :26], record.clouds[:, :26], atol=1e-6)


def test_large_clouds_are_thinned_and_times_may_stand_in_a_file(tmp_path):
    record = record_cases.pushed()
    tool = write(tmp_path, record)
    names = sorted(path.name for path in tmp_path.glob("*.ply"))
    lines = [f"{name},{time}" for name, time in zip(names, record.times, strict=True)]
    (tmp_path / "times.csv").write_text("\n".join(["file,time", *lines]) + "\n")
    read = read_folder(tmp_path, tool, ENV, num_points=10)
    assert read.clouds.shape == (5, 10, 3) and read.mask.all()
    (tmp_path / "times.csv").write_text("file,time\n")
    with pytest.raises(ValueError, match=r"has no time for cloud_00000000.ply"):
        read_folder(tmp_path, tool, ENV)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "frame_{:04d}",
            r"the last of 5 frames in .* is at 4e-06 s, within the first control step of 0.1 s: name the ",
        ),
        ("cloud_0.{:d}", "are no times in microseconds: add a file times.csv"),
    ],
)
def test_numbers_that_are_no_microseconds_are_refused(tmp_path, name, sentence):
    tool = write(tmp_path, record_cases.pushed())
    for i, path in enumerate(sorted(tmp_path.glob("*.ply"))):
        path.rename(tmp_path / f"{name.format(i)}.ply")
    with pytest.raises(ValueError, match=sentence):
        read_folder(tmp_path, tool, ENV)


def test_faults_are_told_in_a_sentence(tmp_path):
    with pytest.raises(ValueError, match="there are no PLY files"):
        read_folder(tmp_path, tmp_path / "tool.csv", ENV)
    tool = write(tmp_path, record_cases.pushed())
    with pytest.raises(ValueError, match="there is no tool path"):
        read_folder(tmp_path, tmp_path / "absent.csv", ENV)
    for text, sentence in {
        "time,x\n0,0\n1,0\n": "has 2 columns: give time and 2 joint positions",
        "time,x,y\n0,0,0\n0,0,0\n": "do not rise",
        "time,x,y\n0,0,0\n0.2,0,0\n": "covers 0 to 0.2 s",
        "time,x,y\n0,a,0\n0.2,0,0\n": "holds 'a'",
        "time,x,y\n0,0,0\n0.2,,0\n": "holds ''",
        "time,x,y\n": "no rows of equal length",
        "time,x,y\n0,0,0\n0.4,0,0\n": "begins 0.1 from joint_start",
        "time,x,y\n0,-0.1,0\n0.1,0.1,0\n0.4,0,0\n": "times as fast as joint_step",
        "time,x,y\n0,-0.1,0\n0.4,-0.13,0\n": "goes 0.02 beyond joint_lower or joint_upper, .* joint_lower of at most .-0.13,",
        "time,x,y\n0,-0.1,0\n0.4,-0.1,0.2\n": "goes 0.1 beyond .* joint_upper of at least .-0.1, 0.2.$",
    }.items():
        tool.write_text(text)
        with pytest.raises(ValueError, match=sentence):
            read_folder(tmp_path, tool, ENV)
    (tmp_path / "cloud_00100000.ply").write_text("no cloud")
    with pytest.raises(ValueError, match="cannot be read as PLY"):
        read_folder(tmp_path, tool, ENV)


def test_actions_follow_the_path():
    path = np.array([[-0.1, 0.0], [-0.095, 0.01], [-0.1, 0.0]])
    np.testing.assert_allclose(actions_of(ENV, path), [[0.5, 1.0], [-0.5, -1.0]], rtol=1e-5)
    outside = SimpleNamespace(**{**vars(ENV), "joint_lower": np.array([-0.095, 0.0])})
    np.testing.assert_allclose(actions_of(outside, path[:2]), [[0.5, 1.0]], rtol=1e-5)  # as FluidMove begins at paper
    still = SimpleNamespace(**{**vars(ENV), "joint_step": np.array([0.01, 0.0])})
    np.testing.assert_allclose(actions_of(still, path * [1.0, 0.0]), [[0.5, 0.0], [-0.5, 0.0]], rtol=1e-5)
    with pytest.raises(ValueError, match="the tool's path is inf times as fast as joint_step allows"):
        actions_of(still, path)
    with pytest.raises(ValueError, match="the joints of WhipRope follow set points, so no actions"):
        actions_of(rewax.make("WhipRope", scale="small"), path)
    with pytest.raises(
        ValueError, match="Hopper has no joint_start: give a task whose actions move the joints of a tool"
    ):
        actions_of(rewax.make("Hopper", scale="small"), path)
