"""``rewax record`` and ``rewax identify``: from a push to a table, a file that environments read, and a picture."""

import json

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import memory_toys
import numpy as np
import pytest
import seeing_toys
from matplotlib.image import imread

import rewax
from rewax import struct
from rewax.cli.identify import priors
from rewax.cli.main import main
from rewax.envs import registry
from rewax.envs.randomize import LogUniform, Uniform
from rewax.identify import load, load_result
from rewax.training.storage import policies
from rewax.training.storage.saved import SavedRun

PUSH = ("--env=RollingFlat", "--action", "0.3", "-1", "0", "--steps", "4", "--every", "2", "--points", "64")


def test_from_a_push_to_a_material(tmp_path, capsys):
    path = tmp_path / "push.npz"
    assert main(["record", *PUSH, "--set", "yield_stress=25", "--noise", "0.002", "--out", str(path)]) == 0
    assert "3 frames over 0.028 s, 64 to 64 points each" in capsys.readouterr().out
    fit = ["identify", str(path), "--env=RollingFlat", "--unknown", "yield_stress=5,80"]
    assert main([*fit, "--starts", "2", "--iterations", "2"]) == 0
    said = capsys.readouterr().out
    assert "yield_stress" in said and "95 % interval" in said and "from the simulated surface" in said
    saved = load_result(tmp_path / "push.json")
    assert saved.made_by == {"env": "RollingFlat", "scale": "small", "kwargs": {}}
    env = saved.apply(rewax.make("RollingFlat", scale="small"))
    assert 5.0 <= float(env.scene.material.plasticity.yield_stress) <= 80.0
    assert len(json.loads((tmp_path / "push.json").read_text())["residual_by_frame"]) == 3
    assert np.ptp(imread(tmp_path / "push.png")) > 0.5
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "push.mp4"))
    assert next(reader)["size"] == (960, 420)
    frames = [np.frombuffer(frame, np.uint8).reshape(420, 960, 3) for frame in reader]
    assert len(frames) == 3
    blue = [(frame.astype(int)[..., 2] - frame[..., 0] > 60).reshape(420, 2, 480).sum((0, 2)) for frame in frames]
    assert np.min(blue) > 50  # the cloud is on both sides; the simulation on one
    tan = [(frame.astype(int)[..., 0] - frame[..., 2] > 40).reshape(420, 2, 480).sum((0, 2)) for frame in frames]
    assert np.all(np.array(tan)[:, 1] > 20 * np.array(tan)[:, 0])


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (["identify", "absent.npz", "--env=RollingFlat"], "there is no record 'absent.npz'"),
        (["record", "--env=RollingFlat"], "give one of --action, --script and --policy"),
        (["record", "--env=RollingFlat", "--action", "1"], "an action has 1 numbers, but RollingFlat takes 3"),
        (
            ["record", *PUSH, "--set", "density=900,1000"],
            "--set gives scene.material.density 2 values: a record has one",
        ),
        (["record", "--env=RollingFlat", "--script", "absent.csv"], "there is no script 'absent.csv'"),
        (["record", "--env=RollingFlat", "--script", "file"], "'file' holds no rows: give one action in a row"),
        (["record", *PUSH, "--every", "100"], "--every is 100 with 4 steps: give at most 4, for a second frame"),
        (["record", "--env=Hopper", "--action", "1"], "Hopper has no soft body"),
        (["identify", "a.npz", "--env=RollingFlat", "--out", "a.png"], "--out is a.png: give a file .json"),
        (["identify", "a.npz", "--env=RollingFlat", "--out", "file/a.json"], "file cannot be written or read"),
        (["record", *PUSH, "--out", "file/a.npz"], "file cannot be written or read"),
    ],
)
def test_mistakes_are_told_in_a_sentence(command, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert main(command) == 2
    message = capsys.readouterr().err
    assert sentence in message and message.count("\n") == 1


def test_priors_are_ranges_or_a_decade():
    env = rewax.make("RollingFlat", scale="small")
    found = priors(["youngs_modulus", "poissons_ratio=0.1,0.4", "yield_stress=0,50"], env)
    decade, narrow, linear = found.values()
    assert decade.high / decade.low == pytest.approx(10.0) and isinstance(decade, LogUniform)
    assert (narrow.low, narrow.high) == (0.1, 0.4) and isinstance(linear, Uniform)
    for texts, sentence in (
        ([], "give at least one --unknown"),
        (["yield_stress=1"], "--unknown is 'yield_stress=1'"),
        (["yield_stress=1,2", "yield_stress=1,2"], "give each parameter once"),
        (["yield_stress=a,b"], "a"),
        (["stickiness=1,2"], "has no parameter 'stickiness'"),
        (["scene.gravity"], "scene.gravity is not one number, .* give scene.gravity=LOW,HIGH"),
        (["scene.gravity[1]"], r"scene.gravity\[1\] is not one number"),
        (["scene.colliders[*].friction"], "is not one number"),
    ):
        with pytest.raises(ValueError, match=sentence):
            priors(texts, env)


def test_the_body_of_the_first_cloud_is_fitted_on_two_grids(tmp_path, capsys):
    path = tmp_path / "push.npz"
    assert main(["record", *PUSH, "--out", str(path)]) == 0
    fit = ["identify", str(path), "--env=RollingFlat", "--unknown", "yield_stress=5,80", "--no-picture", "--video", "0"]
    assert (
        main([*fit, "--body", "hull", "--cells", "16", "20", "--limit", "0", "--starts", "2", "--iterations", "1"]) == 0
    )
    saved = json.loads((tmp_path / "push.json").read_text())
    assert saved["made_by"] == {"env": "RollingFlat", "scale": "small", "kwargs": {}}
    coarse, fine = (np.log(start["scene.material.plasticity.yield_stress"]) for start in saved["starts"])
    step = (1 / 20) / (1 / 16 - 1 / 20)
    expected = np.clip(fine + step * (fine - coarse), np.log(5.0), np.log(80.0))
    assert np.log(saved["values"]["scene.material.plasticity.yield_stress"]) == pytest.approx(expected, abs=1e-3)
    for wrong, sentence in (
        (["--limit", "0"], "--limit is 0 with fewer than two grids"),
        (["--cells", "24", "20"], "--cells is 24.0 20.0: give rising numbers"),
    ):
        capsys.readouterr()
        assert main([*fit, *wrong]) == 2
        assert sentence in capsys.readouterr().err


@struct.dataclass
class Ball(seeing_toys.Visible):
    """The sphere over a floor, with what records need."""

    control_dt: float = struct.static_field(default=0.1)

    def particles(self, physics):
        corners = jnp.stack(jnp.meshgrid(*[jnp.array([-0.2, 0.2])] * 3), axis=-1).reshape(8, 3)
        return corners + jnp.concatenate([physics, jnp.array([0.2, 0.0])])


def test_a_policy_that_sees_and_remembers_moves_the_tool(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(registry._FACTORIES, "Ball", lambda scale: Ball(gain=jnp.float32(0.5)))
    env = rewax.make("Ball", scale="small", sensors=("camera",), resolution=8)
    agent = memory_toys.agent("apg", env, observe=("camera",), picture_widths=(2,), picture_features=2)
    run = SavedRun(env, agent, agent.init(jax.random.key(0)), {"env_kwargs": env.made_by["kwargs"], "scale": "small"})
    asked = []
    monkeypatch.setattr(policies, "open_run", lambda *args, scale: (asked.append(scale), run)[1])
    command = ["record", "--env=Ball", "--policy=run", "--steps=2", "--out", str(tmp_path / "a.npz")]
    assert main(command) == 0 and asked == [None], (
        capsys.readouterr().err
    )  # the run's own scale, which is then the task's
    found, state, memory = load(tmp_path / "a.npz").actions, env.reset(jax.random.split(jax.random.key(0), 4)[0]), None
    for action in found:
        expected, memory = run.act(state.obs, memory=memory)
        np.testing.assert_allclose(action, expected, rtol=1e-4, atol=1e-5)
        state = env.step(state, expected)
    assert found[0] != found[1]
    monkeypatch.setattr(policies, "open_run", lambda *args, **kwargs: run._replace(config={}))
    assert main(command) == 2
    assert "the policy of 'run' observes camera (8, 8, 1), which Ball does not" in capsys.readouterr().err
