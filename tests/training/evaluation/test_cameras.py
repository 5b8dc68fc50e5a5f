"""A recording holds what the cameras of an environment show: as observed, in bytes, with the bodies' names."""

import jax
import jax.numpy as jnp
import numpy as np
import seeing_toys
import toys

from rewax.envs import AutoReset, Randomized
from rewax.envs.latency import Latency
from rewax.envs.randomize import camera, hook
from rewax.envs.sensing import Sensing
from rewax.sensors import DepthCloud, DepthNoise
from rewax.training import constant_policy, record
from rewax.training.evaluation.cameras import as_recorded, has_cameras
from rewax.viz.seen import LARGEST_SIDE, NOTHING

MOVE = constant_policy(jnp.array([-0.2]))


def recorded(env, **options):
    return record(env, MOVE, None, jax.random.key(1), **options)


def states(env):
    """The states of the recorded episode: the first one and one after each step."""
    reset_key, _ = jax.random.split(jax.random.key(1))
    found, step = [jax.jit(env.reset)(reset_key)], jax.jit(env.step)
    for _ in range(env.episode_length):
        found.append(step(found[-1], jnp.array([-0.2])))
    return found


def test_depth_is_what_was_observed_and_bodies_are_what_is_there():
    env = seeing_toys.sensing(noise=DepthNoise(constant=0.02, dropout=0.1))
    depth, bodies = recorded(env).seen
    view = jax.jit(lambda physics: env.sensors["depth"].view(env.world(physics)))
    assert depth.title == "depth [m]" and (depth.near, depth.far) == (1.0, 4.0) and bodies.names == ("ball", "floor")
    for frame, state in enumerate(states(env)):
        observed, pixels = np.asarray(state.obs["depth"][..., 0]), depth.pixels[frame]
        assert ((observed < 1.0) == (pixels < NOTHING)).all() and 0.05 < (pixels == NOTHING).mean() < 0.6
        np.testing.assert_allclose(pixels[observed < 1.0] / 254.0, observed[observed < 1.0], atol=0.51 / 254.0)
        labels = bodies.pixels[frame].astype(int)
        np.testing.assert_array_equal(np.where(labels == NOTHING, -1, labels), view(state.physics).label)
    assert {0, 1} <= {*bodies.pixels.ravel().tolist()}


def test_latency_is_seen_and_bodies_are_those_of_now():
    late, prompt = recorded(Latency(env=seeing_toys.sensing(), observation=2)), recorded(seeing_toys.sensing())
    np.testing.assert_array_equal(late.seen[0].pixels, prompt.seen[0].pixels[[0, 0, 0, 1, 2, 3]])
    np.testing.assert_array_equal(late.seen[1].pixels, prompt.seen[1].pixels)
    assert (prompt.seen[0].pixels[0] != prompt.seen[0].pixels[-1]).any()


def test_a_drawn_camera_shows_its_own_bodies():
    moved = hook(camera("sensors[depth]", position=0.3, rotation=0.2))
    env = Randomized(env=seeing_toys.sensing(), randomize=moved)
    drawn, (_, plain) = recorded(env).seen, recorded(as_recorded(env)).seen
    sees = np.where(drawn[0].pixels[0] == NOTHING, NOTHING, 0)
    np.testing.assert_array_equal(sees, np.where(drawn[1].pixels[0] == NOTHING, NOTHING, 0))  # both at one pose
    assert (drawn[1].pixels[0] != plain.pixels[0]).mean() > 0.02


def test_a_cloud_shows_its_cameras_picture_and_large_pictures_are_thinned():
    cloud = DepthCloud(camera=seeing_toys.front_camera(height=200, width=300), num_points=8)
    env = Sensing(env=seeing_toys.visible(), sensors={"cloud": cloud})
    depth, bodies = recorded(env, max_frames=2).seen
    assert depth.pixels.shape == bodies.pixels.shape == (2, 67, 100) and max(depth.pixels.shape) <= LARGEST_SIDE
    reset_key, _ = jax.random.split(jax.random.key(1))
    whole = jax.jit(lambda key: cloud.camera.depth(env.world(env.reset(key).physics)))(reset_key)[::3, ::3]
    seen = depth.pixels[0] < NOTHING
    np.testing.assert_allclose(depth.pixels[0][seen] / 254.0 * 3.0 + 1.0, whole[seen], atol=0.51 / 254.0 * 3.0)


def test_without_cameras_nothing_is_seen_and_draws_are_left_out():
    bare = toys.point_mass()
    assert recorded(bare).seen == [] and not has_cameras(bare) and has_cameras(seeing_toys.sensing())
    late = Latency(env=seeing_toys.sensing())
    assert as_recorded(AutoReset(env=Randomized(env=late, randomize=lambda key, env: env))) is late
    seeing = seeing_toys.sensing()
    drawn_inside = seeing.replace(env=Randomized(env=seeing.env, randomize=lambda key, env: env))
    assert as_recorded(Latency(env=drawn_inside)).env.env is seeing.env
