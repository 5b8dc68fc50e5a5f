"""Exported policies act as the run does, in processes that have no rewax."""

import dataclasses
import functools
import json
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.agents.normalization import update_statistics
from rewax.agents.registry import algorithm
from rewax.cli.main import main
from rewax.envs.base import ArraySpec
from rewax.training.storage.export import export_policy
from rewax.training.storage.numpy_policy import NumpyPolicy
from rewax.training.storage.saved import SavedRun

WIDTHS = {"num_envs": 2, "actor_widths": (6, 5), "vector_features": 4, "point_widths": (3, 4), "point_features": 3}
READ = {
    "numpy": "from numpy_policy import NumpyPolicy\npolicy = NumpyPolicy('weights.npz')\n"
    "action = [policy({name: a[i] for name, a in obs.items()}, noise[i]) for i in range(len(noise))]\n"
    "assert 'jax' not in sys.modules\n",
    "stablehlo": "import jax; from jax import export; from pathlib import Path\n"
    "call = export.deserialize(bytearray(Path('policy.stablehlo').read_bytes())).call\n"
    "action = call({name: jax.numpy.asarray(a) for name, a in obs.items()}, jax.numpy.asarray(noise))\n",
}


@struct.dataclass
class SeesPoints(toys.PointMass):
    """It observes points and two vectors, and has two action components."""

    @property
    def observation_spec(self):
        return {"cloud": ArraySpec((8, 3)), "x": ArraySpec((1,)), "also": ArraySpec((2, 1, 2))}

    @property
    def action_spec(self):
        return ArraySpec((2,), -1.0, 1.0)

    def reset(self, key):
        state = super().reset(key)
        obs = {"cloud": self.particles(state.physics), "x": state.obs["x"], "also": jnp.ones((2, 1, 2))}
        return state.replace(obs=obs)


@functools.cache
def saved(name, **changes):
    """A run that has seen some observations and learnt nothing."""
    env, known = SeesPoints(gain=jnp.float32(0.5)), algorithm(name)
    config = dataclasses.replace(known.config_type(**WIDTHS), **changes)
    agent = known.make(env, config)
    state = agent.init(jax.random.key(3))
    statistics = jax.jit(update_statistics)(state.environments.statistics, batch(32, seed=1))
    state = state.replace(environments=state.environments.replace(statistics=statistics))
    described = json.loads(json.dumps({"agent": name, name: dataclasses.asdict(config)}))
    return SavedRun(env, agent, state, described)


def batch(size, seed=0):
    generator = np.random.default_rng(seed)
    spec = SeesPoints(gain=jnp.float32(0.5)).observation_spec
    return {name: generator.normal(2.0, 3.0, (size, *s.shape)).astype(np.float32) for name, s in spec.items()}


def test_files_that_cannot_be_written_stay_as_they_were(tmp_path, weights, monkeypatch):
    folder = shutil.copytree(weights.parent, tmp_path / "policy")
    before = {path: path.read_bytes() for path in folder.iterdir()}

    def full(file, **arrays):
        file.write_bytes(b"part")
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="no space left"):
        export_policy(saved("sapo"), folder)
    assert (folder / "weights.npz").read_bytes() == before[folder / "weights.npz"]
    assert sorted(folder.iterdir()) == sorted(before)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("sapo", {}),
        pytest.param("shac", {"state_dependent_std": False, "observation_clip": 0.5}, marks=pytest.mark.slow),
        ("ppo", {"activation": "tanh", "normalize_observations": False}),
    ],
)
def test_they_act_as_the_run_does(name, changes, tmp_path):
    run = saved(name, **changes)
    written = export_policy(run, tmp_path)
    assert sorted(path.name for path in written) == [
        "numpy_policy.py",
        "policy.json",
        "policy.stablehlo",
        "weights.npz",
    ]
    obs, noise = batch(3), np.zeros((3, 2), np.float32)
    expected = jax.vmap(run.act)(obs)
    np.savez(tmp_path / "given.npz", **obs, noise=noise)
    code = (
        "import sys, numpy as np; sys.path.insert(0, '.'); sys.modules['rewax'] = None\n"
        "given = dict(np.load('given.npz')); noise = given.pop('noise'); obs = given\n"
    ) + "".join(f"{read}np.save('{how}.npy', action)\n" for how, read in READ.items())
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    for how in READ:
        np.testing.assert_allclose(np.load(tmp_path / f"{how}.npy"), expected, rtol=1e-4, atol=2e-5)


def test_a_policy_with_memory_acts_as_the_run_does_step_by_step(tmp_path, weights):
    run = saved("sapo", memory=5)
    export_policy(run, tmp_path)
    exported = jax.export.deserialize(bytearray((tmp_path / "policy.stablehlo").read_bytes()))
    policy, noise = NumpyPolicy(tmp_path / "weights.npz"), jnp.zeros((3, 2))
    memory = jnp.zeros((3, 5))
    alone, own = [policy.initial_memory()] * 3, None
    act = jax.vmap(lambda obs, memory: run.act(obs, memory=memory))
    for step in range(4):
        obs = batch(3, seed=step)
        action, now = act(obs, memory)
        for found, expected in zip(exported.call(obs, noise, memory), (action, now), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=2e-5)
        for i in range(3):
            found, alone[i] = policy({name: a[i] for name, a in obs.items()}, memory=alone[i])
            np.testing.assert_allclose(found, action[i], rtol=1e-4, atol=2e-5)
            np.testing.assert_allclose(alone[i], now[i], rtol=1e-4, atol=2e-5)
        moved, own = run.act({name: a[0] for name, a in obs.items()}, memory=own)
        np.testing.assert_allclose(moved, action[0], rtol=1e-5, atol=1e-6)
        assert np.abs(now - memory).max() > 1e-3
        memory = now
    first = {name: a[0] for name, a in batch(1).items()}
    with pytest.raises(ValueError, match=r"memory is None: give shape \(5,\), at first initial_memory\(\)"):
        policy(first)
    plain = NumpyPolicy(weights)
    assert plain.initial_memory() is None
    with pytest.raises(ValueError, match="memory is given, but this policy has none: leave it out"):
        plain(first, memory=np.zeros(5))
    with pytest.raises(ValueError, match="memory is given, but this policy has none: leave it out"):
        saved("sapo").act(first, memory=np.zeros(5))


def test_noise_is_that_of_the_policys_distribution(tmp_path):
    run = saved("sapo", initial_log_std=-1.0)
    export_policy(run, tmp_path)
    exported = jax.export.deserialize(bytearray((tmp_path / "policy.stablehlo").read_bytes()))
    obs = {name: np.repeat(a, 2000, axis=0) for name, a in batch(1).items()}
    keys = jax.random.split(jax.random.key(0), 2000)
    sampled = jax.vmap(lambda o, k: run.agent.policy(run.train_state, o, k))(obs, keys)
    found = exported.call(obs, jax.random.normal(jax.random.key(1), (2000, 2)))
    np.testing.assert_allclose(jnp.arctanh(found).std(0), jnp.arctanh(sampled).std(0), rtol=0.1)
    assert set(exported.platforms) == {"cpu", "cuda"}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"x": None}, r"the observation has no array 'x', only cloud, also: give all of \{"),
        ({"cloud": np.zeros((9, 3))}, r"'cloud' of the observation has shape \(9, 3\): give \(8, 3\)"),
        ({"x": np.zeros((4, 1))}, r"'x' of the observation has shape \(4, 1\): give \(1,\), that of one environment"),
        ("array", "the observation is a ndarray: give a dict of arrays"),
    ],
)  # fmt: skip
def test_the_numpy_policy_says_what_is_wrong_with_an_observation(changes, sentence, weights):
    policy = NumpyPolicy(weights)
    obs = {"cloud": np.zeros((8, 3)), "x": np.zeros(1), "also": np.zeros((2, 1, 2)), "more": np.zeros(7)}
    assert policy(obs).shape == (2,)
    del obs["more"]
    wrong = np.zeros(3) if changes == "array" else {k: v for k, v in {**obs, **changes}.items() if v is not None}
    with pytest.raises(ValueError, match=sentence):
        policy(wrong)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    export_policy(saved("sapo"), folder)
    return folder / "weights.npz"


def test_an_algorithm_without_a_policy_is_refused():
    env, known = toys.point_mass(), algorithm("trajopt")
    agent = known.make(env, known.config_type(num_envs=2))
    run = SavedRun(env, agent, agent.init(jax.random.key(0)), {"agent": "trajopt", "trajopt": {"num_envs": 2}})
    with pytest.raises(
        ValueError,
        match=r"^trajopt has no policy of rewax.agents.actor_critic.make_actor, and no other can be exported",
    ):
        export_policy(run, "unused")


def test_the_command_needs_a_run(tmp_path, capsys):
    assert main(["export", str(tmp_path / "nothing")]) == 2
    assert "nothing' is neither the directory of a run" in capsys.readouterr().err
