"""Recordings follow an episode to its end, step by step, whatever the environment's pictures are made with."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.envs import AutoReset, Randomized, stack
from rewax.envs.kit.rigid_task import RigidPhysics, RigidTask
from rewax.envs.memory import MEMORY, Remembered
from rewax.envs.randomize import Constant, Scale, hook
from rewax.physics import rigid
from rewax.training.evaluation.episodes import constant_policy
from rewax.training.evaluation.recording import can_record, check_color_by, record, snapshots
from rewax.viz.camera import frame_recording
from rewax.viz.software import SoftwareRenderer

KEY = jax.random.key(0)


@struct.dataclass
class Ending(toys.PointMass):
    """Ends beyond 1.9, with a status bit from 1.4 on."""

    def step(self, state, action):
        x = state.physics + self.gain * action
        return self.after(state, x, terminated=x[0] > 1.9, status=jnp.where(x[0] > 1.4, 4, 0))


@struct.dataclass
class Shown(toys.PointMass):
    """A ball at x, drawn by code that needs numbers."""

    control_dt: float = struct.static_field(default=0.1)
    up = np.array([0.0, 0.0, 1.0])
    appearance = {"floor": -0.5, "camera": {"azimuth": 10.0}}  # noqa: RUF012

    def render_shapes(self, physics):
        return [{"kind": "sphere", "center": np.array([float(physics[0]), 0.0, 0.0]), "radius": 0.1, "opacity": 0.5}]

    def particle_values(self, physics):
        return {"speed": jnp.full(8, physics[0])}


def recorded(env, action, **options):
    return record(env, constant_policy(jnp.array([action])), None, KEY, **options)


def test_every_step_is_on_the_path_and_rewards_are_those_of_the_steps():
    found = recorded(toys.point_mass(length=6), 0.2, name="toy")
    assert found.steps.tolist() == [0, 1, 2, 3, 4, 5, 6] and found.name == "toy"
    x = found.particles[:, 0, 0]
    np.testing.assert_allclose(np.diff(x), 0.1, atol=1e-6)
    np.testing.assert_allclose(found.rewards, -(x[1:] ** 2), rtol=1e-5)
    np.testing.assert_allclose(found.actions, np.full((6, 1), 0.2), rtol=1e-6)
    assert all(len(values) == 6 for values in found.metrics.values())
    np.testing.assert_allclose(found.totals, np.concatenate([[0.0], np.cumsum(-(x[1:] ** 2))]), rtol=1e-5)


def test_a_policy_with_memory_is_recorded_with_the_actions_that_it_remembers():
    def counting(train_state, obs, key, deterministic=False):
        """It counts its steps and moves by their number."""
        del train_state, key, deterministic
        return Remembered(0.1 * obs[MEMORY], obs[MEMORY] + 1.0)

    counting.initial_memory = lambda: jnp.zeros(1)
    found = record(toys.point_mass(length=6), counting, None, KEY)
    np.testing.assert_allclose(found.actions[:, 0], 0.1 * np.arange(6), rtol=1e-6)
    np.testing.assert_allclose(np.diff(found.particles[:, 0, 0]), 0.05 * np.arange(6), atol=1e-6)


def test_a_memory_begins_as_the_policy_says():
    def remembers(train_state, obs, key, deterministic=False):
        return Remembered(obs[MEMORY], obs[MEMORY])

    remembers.initial_memory = lambda: jnp.full(1, 0.7)
    np.testing.assert_allclose(record(toys.point_mass(length=3), remembers, None, KEY).actions[:, 0], 0.7)
    remembers.initial_memory = lambda: jnp.zeros((2, 3))
    with pytest.raises(ValueError, match=r"initial_memory\(\) of the policy has shape \(2, 3\): return one of shape"):
        record(toys.point_mass(length=3), remembers, None, KEY)


def test_of_an_environment_with_automatic_reset_one_episode_is_recorded():
    one, again = (recorded(env, 0.2) for env in (toys.point_mass(length=3), AutoReset(env=toys.point_mass(length=3))))
    np.testing.assert_array_equal(again.rewards, one.rewards)
    np.testing.assert_array_equal(again.steps, one.steps)
    with pytest.raises(ValueError, match="env is a batch of environments: record one of them"):
        recorded(stack([toys.point_mass(), toys.point_mass()]), 0.2)


def test_particles_are_coloured_by_the_names_that_pictures_have(monkeypatch):
    values = {"height": jnp.zeros(8), "mass": jnp.zeros(8)}
    monkeypatch.setattr(toys.PointMass, "particle_values", lambda self, physics: values, raising=False)
    for name in ("height", "height (recorded)", "mass"):
        check_color_by(toys.point_mass(), name)
    with pytest.raises(ValueError, match=r"use one of material, height, height \(recorded\), mass"):
        check_color_by(toys.point_mass(), "smell")
    check_color_by(object(), "material")
    with pytest.raises(ValueError, match=r"^color_by is 'mass', but the environment has no particles: leave it out"):
        check_color_by(object(), "mass")


def test_a_misspelt_appearance_is_a_sentence(monkeypatch):
    monkeypatch.setattr(toys.PointMass, "appearance", {"flor": 0.0}, raising=False)
    with pytest.raises(ValueError, match="appearance has 'flor': did you mean 'floor'"):
        recorded(toys.point_mass(), 0.2)


def test_long_episodes_are_shown_every_few_steps_and_no_reward_is_lost():
    whole = recorded(toys.point_mass(length=7), 0.2)
    some = recorded(toys.point_mass(length=7), 0.2, max_frames=4)
    assert some.steps.tolist() == [0, 3, 6, 7] and len(some.rewards) == 7
    np.testing.assert_array_equal(some.particles, whole.particles[[0, 3, 6, 7]])
    np.testing.assert_array_equal(some.rewards, whole.rewards)


@pytest.mark.parametrize("max_frames", [301, 3])
def test_nothing_is_recorded_after_the_end(max_frames):
    found = recorded(Ending(gain=jnp.float32(0.5), length=6), 1.0, max_frames=max_frames)
    last = int(found.steps[-1])
    assert 0 < last < 6 and len(found.rewards) == len(found.status) == last
    assert found.particles[-1, 0, 0] > 1.9 and found.status[-1] == 4
    whole = recorded(Ending(gain=jnp.float32(0.5), length=6), 1.0)
    assert np.all(whole.particles[:-1, 0, 0] <= 1.9)


MESH = {"vertices": np.eye(4, 3, dtype=np.float32), "triangles": np.array([[0, 1, 2], [0, 3, 1]])}


@struct.dataclass
class Meshed(toys.PointMass):
    """A mesh at x."""

    def render_shapes(self, physics):
        center = jnp.array([physics[0], 0.0, 0.0])
        return [{"kind": "mesh", "center": center, "rotation": jnp.eye(3), **MESH}]


def test_arrays_of_numpy_are_kept_once_for_all_frames():
    found = recorded(Meshed(gain=jnp.float32(0.5), length=4), 0.2)
    (first,), *later = found.drawings
    centers = [first["center"][0], *(shapes[0]["center"][0] for shapes in later)]
    np.testing.assert_allclose(centers, found.particles[:, 0, 0], rtol=1e-6)
    for key, values in MESH.items():
        assert all(shapes[0][key] is values for shapes in found.drawings)


GEM = """<mujoco><asset><mesh name="gem" vertex=".3 0 0 -.3 0 0 0 .3 0 0 -.3 0 0 0 .3 0 0 -.3"/></asset><worldbody>
  <body pos="0 0 1"><joint type="slide" axis="1 0 0"/><geom type="mesh" mesh="gem" contype="0" conaffinity="0"/></body>
  <body pos="0 0 .4"><joint type="slide" axis="1 0 0"/><geom type="ellipsoid" size=".3 .1 .1" contype="0" conaffinity="0"/>
  </body></worldbody></mujoco>"""


@struct.dataclass
class Gem(RigidTask):
    """A mesh over an ellipsoid; both slide along x."""

    def start(self, key):
        return rigid.initial_state(self.model), None

    def observe(self, physics):
        return {"qpos": physics.rigid.qpos}

    def reward(self, physics):
        return physics.rigid.qpos[0], {}


def test_meshes_and_ellipsoids_of_a_model_are_in_its_pictures():
    env = Gem(model=rigid.load(GEM), num_substeps=1, max_steps=1)
    first = env.reset(jax.random.key(0))
    states = [rigid.initial_state(env.model, qpos=jnp.array([0.0, x])) for x in (0.0, 0.2)]
    found = snapshots(env)([first.replace(physics=RigidPhysics(rigid=s, action=jnp.zeros(0))) for s in states])
    assert [shape["kind"] for shape in found.drawings[0]] == ["mesh", "ellipsoid"]
    first, second = found.drawings
    assert first[0]["vertices"] is second[0]["vertices"] and len(first[0]["vertices"]) == 6
    np.testing.assert_allclose(second[1]["center"], [0.2, 0.0, 0.4], atol=1e-6)
    red = dataclasses.replace(found, drawings=[[{**shape, "color": (0.9, 0.0, 0.0)} for shape in first]] * 2)
    picture = SoftwareRenderer(red, height=90, width=120).render(0).astype(int)
    camera = frame_recording(red).camera(0, red.up)
    columns, rows, _ = camera.project(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.4], [0.27, 0.0, 1.27]]), 90, 120)
    seen = picture[rows.astype(int), columns.astype(int)]
    shown = seen[:, 0] > 2 * seen[:, 2]
    assert shown.tolist() == [True, True, False]


def test_pictures_show_the_parameters_that_the_episode_drew():
    env = Gem(model=rigid.load(GEM), num_substeps=1, max_steps=1)
    twice = hook({"model.parameters[geom_size]": Scale(Constant(2.0))})
    radii = []
    for one in (env, AutoReset(env=Randomized(env=env, randomize=twice))):
        state = one.reset(jax.random.key(0))
        radii.append(snapshots(one)([state]).drawings[0][1]["semi_axes"])
    np.testing.assert_allclose(radii[1], 2.0 * np.asarray(radii[0]), rtol=1e-6)


def test_code_that_cannot_be_traced_is_called_as_it_is():
    found = recorded(Shown(gain=jnp.float32(0.5), length=3), 0.2)
    centers = [shapes[0]["center"][0] for shapes in found.drawings]
    np.testing.assert_allclose(centers, found.particles[:, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(found.values["speed"][:, 3], centers, rtol=1e-6)
    assert found.control_dt == 0.1 and found.floor == -0.5 and found.camera == {"azimuth": 10.0}
    np.testing.assert_array_equal(found.up, [0.0, 0.0, 1.0])
    assert found.drawings[0][0]["kind"] == "sphere" and float(found.drawings[0][0]["opacity"]) == 0.5


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="max_frames is 1: use 2 or more"):
        recorded(toys.point_mass(), 0.0, max_frames=1)
    assert not can_record(object()) and can_record(toys.point_mass())
    with pytest.raises(ValueError, match="neither particles\\(physics\\) nor render_shapes\\(physics\\)"):
        record(object(), constant_policy(jnp.zeros(1)), None, KEY)
