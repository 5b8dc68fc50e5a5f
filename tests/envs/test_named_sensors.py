"""Sensors by name: ``make(..., sensors=...)`` adds them, cameras show the task, runs remember them."""

import jax
import numpy as np
import pytest

import rewax
from rewax.envs import named_sensors
from rewax.envs.named_sensors import default_camera, list_sensors, register_sensor, with_sensors
from rewax.envs.randomized import Randomized
from rewax.sensors import Camera, Labels
from rewax.sensors.framing import carried, framing
from rewax.testing import check_env

KEY = jax.random.key(0)


def test_make_adds_sensors_and_remembers_them():
    env = rewax.make("CartpoleSwingUp", scale="small", sensors=["camera", "labels"], resolution=16)
    state = jax.jit(env.reset)(KEY)
    assert state.obs["camera"].shape == (16, 16, 1)
    assert state.obs["labels"].shape[:2] == (16, 16)
    spec = env.observation_spec["camera"]
    assert (spec.shape, spec.low, spec.high) == ((16, 16, 1), 0.0, 1.0)
    assert state.obs["camera"].min() < 1.0, "the camera sees nothing"
    again = rewax.make(env.made_by["env"], scale=env.made_by["scale"], **env.made_by["kwargs"])
    np.testing.assert_array_equal(jax.jit(again.reset)(KEY).obs["camera"], state.obs["camera"])


@pytest.mark.slow
def test_pictures_of_a_robot_pass_the_check():
    """The fast one, of a toy, is in test_sensing.py."""
    sensors = ("camera", "cloud", "labels")
    env = rewax.make("CartpoleSwingUp", scale="small", sensors=sensors, resolution=8)
    assert set(sensors) < set(env.observation_spec)
    check_env(env, check_full_episode=False, notify=None)


@pytest.mark.parametrize("sensors", [None, ()])
def test_no_sensors_are_the_environment_alone(sensors):
    env = rewax.make("CartpoleSwingUp", scale="small", sensors=sensors)
    assert set(env.observation_spec) == {"state"} and type(env).__name__ == "CartpoleSwingUp"


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            {"sensors": ["camra"]},
            r"there is no sensor named 'camra': did you mean 'camera'\? known are camera, cloud, ",
        ),
        ({"sensors": 3}, r"sensors is 3: give names, \('camera',\) for example"),
        ({"sensors": ["camera", "camera"]}, "sensors is .*, with a name twice: give each once"),
        ({"sensors": ["camera"], "resolution": 0}, "resolution is 0: give an integer of pixels, at least 1"),
        ({"sensors": ["camera"], "resolution": True}, "resolution is True: give an integer"),
        ({"resolution": 64}, r"resolution is that of pictures: give it together with sensors=\('camera',\)"),
        ({"sensors": ["touch"], "resolution": 64}, "resolution is 64, but touch takes no pictures: leave it out"),
        ({"resolution": 64, "sensors": ()}, r"resolution is that of pictures: give it together with sensors="),
    ],
)
def test_bad_sensors_are_a_sentence(options, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        rewax.make("CartpoleSwingUp", scale="small", **options)


def test_sensors_of_ones_own_get_names(monkeypatch):
    monkeypatch.setattr(named_sensors, "_FACTORIES", dict(named_sensors._FACTORIES))
    register_sensor("wide", lambda env, size: default_camera(env, size).replace(field_of_view=90.0))
    env = rewax.make("CartpoleSwingUp", scale="small", sensors=("wide",), resolution=8)
    assert env.sensors["wide"].field_of_view == 90.0
    assert list_sensors(env) == ["camera", "cloud", "labels", "wide"]
    with pytest.raises(ValueError, match="a sensor named 'wide' is registered already: choose another name"):
        register_sensor("wide", lambda env, size: default_camera(env, size))
    with pytest.raises(ValueError, match="the factory of 'x' is 'nowhere': give a function or"):
        register_sensor("x", "nowhere")
    register_sensor("x", "rewax.envs.named_sensors:no_such")
    with pytest.raises(ValueError, match=r"has no no_such: correct its"):
        with_sensors(rewax.make("CartpoleSwingUp", scale="small"), ["x"])


def test_touch_is_a_sensor_by_name():
    assert "touch" not in list_sensors(rewax.make("CartpoleSwingUp", scale="small")), "nothing of it can touch anything"
    env = rewax.make("Hopper", scale="small", sensors=("touch",))
    felt = jax.jit(env.reset)(KEY).obs["touch"]
    assert felt.shape == env.observation_spec["touch"].shape and not felt.any()
    varied = Randomized(env=rewax.make("Hopper", scale="small"), randomize=lambda key, env: env)
    assert with_sensors(varied, ("touch",)).observation_spec["touch"].shape == felt.shape


def test_a_runner_carries_its_camera():
    """In the world it stands where a camera without a body stands at the first state; later it moves with the torso."""
    env = rewax.make("Hopper", scale="small")
    world = env.world(jax.jit(env.reset)(KEY).physics, np.asarray(env.up))
    still, moving = framing(world, np.asarray(env.up)), default_camera(env)
    assert moving.body == 1
    for one, other in zip(still.pose_in(world), moving.pose_in(world), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
    assert carried(still, world, None) is still


@pytest.mark.parametrize("name", ["RollingFlat", "HandLift"])
def test_policies_that_were_trained_find_their_camera_where_it_was(name):
    """The rows of benchmarks/seeing.py are of a camera above the front of the particles that key 0 draws."""
    env = rewax.make(name, scale="small")
    x = np.asarray(env.particles(env.reset(KEY).physics))
    middle, size, up, side = x.mean(0), np.ptp(x, axis=0).max() + 0.15, np.asarray(env.up), np.array([0.0, 0.0, 1.0])
    eye = middle + size * (side + 1.4 * up + 0.3 * np.cross(up, side))
    away = float(np.linalg.norm(eye - middle))
    wanted = Camera.look_at(
        middle - 0.02 * up, eye=eye, up=up, near=away - 0.8 * size, far=away + 1.2 * size, field_of_view=40.0
    )
    camera = default_camera(env)
    np.testing.assert_allclose(camera.position, wanted.position, atol=1e-6)
    np.testing.assert_allclose(camera.rotation, wanted.rotation, atol=1e-6)
    for each in ("near", "far", "field_of_view", "height", "width", "body", "noise"):
        assert getattr(camera, each) == getattr(wanted, each)


def test_labels_are_masks_of_bodies():
    env = rewax.make("CartpoleSwingUp", scale="small")
    world = env.world(jax.jit(env.reset)(KEY).physics, np.asarray(env.up))
    camera = default_camera(env, 24)
    name = world.names[0]

    @jax.jit
    def seen(world):
        all_names, one = Labels(camera=camera), Labels(camera=camera, of=(name,))
        return all_names.see(world, KEY), one.see(world, KEY), camera.view(world).label

    masks, first, label = (np.asarray(a) for a in seen(world))
    assert masks.shape == (24, 24, len(world.names)) and masks.any(axis=(0, 1)).any()
    np.testing.assert_array_equal(masks.any(axis=-1), label >= 0)
    np.testing.assert_array_equal(first[..., 0], label == 0)
    with pytest.raises(ValueError, match="of has 'nobody', which nothing is named: use"):
        Labels(camera=camera, of=("nobody",)).see(world, KEY)


def test_a_camera_that_frames_nothing_says_so():
    from rewax.sensors import World

    with pytest.raises(ValueError, match="nothing in the world has bounds, so nothing says where to look"):
        framing(World(), (0.0, 1.0, 0.0))
    assert isinstance(default_camera(rewax.make("CartpoleSwingUp", scale="small"), 8), Camera)
