"""A camera is moved by metres and radians, stays a camera, and moves nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import seeing_toys

from rewax.envs import Randomized, Vmap
from rewax.envs.latency import Latency
from rewax.envs.randomize import Constant, Normal, Per, Scale, Turn, Uniform, camera, hook
from rewax.sensors import DepthNoise

SENSING = seeing_toys.sensing(zoom=1.0, noise=DepthNoise(constant=0.0))
NAME = "sensors[depth]"


def many(draws, env=SENSING, num_envs=256):
    """Cameras drawn for several keys, stacked."""
    keys = jax.random.split(jax.random.key(0), num_envs)
    return jax.jit(jax.vmap(lambda key: hook(draws)(key, env).sensors["depth"]))(keys)


def test_position_moves_by_metres_and_rotation_by_radians_and_stays_a_rotation():
    cameras = many(camera(NAME, position=0.02, rotation=0.1))
    moved = np.asarray(cameras.position - SENSING.sensors["depth"].position)
    assert np.abs(moved).max() <= 0.0200001 and (np.abs(moved).max(axis=0) > 0.019).all()
    assert np.abs(np.corrcoef(moved.T) - np.eye(3)).max() < 0.3  # coordinates are drawn apart
    rotation, first = np.asarray(cameras.rotation, float), np.asarray(SENSING.sensors["depth"].rotation, float)
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-6
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-6)
    turn = first.T @ rotation
    angle = np.arccos(np.clip(0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0), -1.0, 1.0))
    assert 0.09 < angle.max() < 0.1 * np.sqrt(3.0) + 1e-4
    vector = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1)
    vector *= 0.5 * (angle / np.sin(angle))[:, None]
    assert np.abs(vector).max() <= 0.1001 and (np.abs(vector).max(axis=0) > 0.09).all()


def test_a_constant_turn_is_the_rotation_by_its_vector():
    turned = hook({f"{NAME}.rotation": Turn(Constant(0.3))})(jax.random.key(0), SENSING).sensors["depth"].rotation
    cross = 0.3 * np.array([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
    power, expected = np.eye(3), np.eye(3)
    for n in range(1, 20):  # the series of the matrix exponential
        power = power @ cross / n
        expected = expected + power
    np.testing.assert_allclose(turned, SENSING.sensors["depth"].rotation @ expected, atol=1e-6)


def test_pictures_differ_between_environments_and_physics_does_not():
    draws = {**camera(NAME, position=0.05, rotation=0.05, zoom=0.1), f"{NAME}.noise.constant": Uniform(0.0, 0.05)}
    plain = {f"{NAME}.noise.constant": Constant(0.0)}

    def stepped(randomize):
        env = Vmap(env=Randomized(env=SENSING, randomize=randomize))
        keys = jax.random.split(jax.random.key(0), 3)
        return jax.jit(lambda keys: env.step(env.reset(keys), jnp.full((3, 1), -0.2)))(keys)

    state, other = stepped(hook(draws)), stepped(hook(plain))
    pictures = np.asarray(state.obs["depth"])
    for a, b in ((0, 1), (1, 2), (0, 2)):
        assert (np.abs(pictures[a] - pictures[b]) > 0.01).mean() > 0.2
    assert len(state.drawn) == 4
    # From the same keys with other draws, all is equal but the pictures.
    np.testing.assert_array_equal(state.physics, other.physics)
    np.testing.assert_array_equal(state.reward, other.reward)
    assert np.abs(pictures - other.obs["depth"]).max(axis=(1, 2, 3)).min() > 0.01


def test_zoom_scales_the_picture_about_its_center():
    wide, near = (seeing_toys.front_camera(zoom=zoom, height=64, width=64) for zoom in (1.0, 1.3))
    world = SENSING.world(jnp.array([1.0]))

    @jax.jit
    def seen(camera):
        depth = camera.depth(world)
        return depth, camera.view(world).label == 0, camera.points(depth)

    (depth, ball, _), (_, near_ball, points) = seen(wide), seen(near)
    assert near_ball.sum() / ball.sum() == pytest.approx(1.3**2, rel=0.1)
    np.testing.assert_array_equal(depth, seen(seeing_toys.front_camera(height=64, width=64))[0])
    points = np.asarray(points)[np.asarray(near_ball)]
    np.testing.assert_allclose(np.linalg.norm(points - [1.0, 0.2, 0.0], axis=-1), 0.2, atol=1e-5)


def test_draws_reach_through_wrappers():
    env = Latency(env=SENSING, observation=1)
    moved = hook(camera(f"env.{NAME}", position=0.1))(jax.random.key(0), env)
    assert np.abs(moved.env.sensors["depth"].position - SENSING.sensors["depth"].position).max() > 0.01


REFUSED = {
    r"^position of sensors\[depth\] is -1: give a number from 0 on$": lambda: camera(NAME, position=-1),
    r"^zoom of sensors\[depth\] is 0.5: give a number from 0 on, below 0.5$": lambda: camera(NAME, zoom=0.5),
    r"^nothing of sensors\[depth\] is drawn: give position, rotation or zoom$": lambda: camera(NAME),
    r"^Turn.by is 0.1: give a distribution": lambda: Turn(0.1),
    r"^Turn.by has Per.ELEMENT: leave per out": lambda: Turn(Normal(0.0, 0.1, per=Per.ELEMENT)),
    r"position has shape \(3,\): Turn is for rotation matrices, of shape \(3, 3\)": lambda: many(
        {f"{NAME}.position": Turn(Normal(0.0, 0.1))}
    ),
    r"the draw of gain is 3: give a distribution, Scale\(...\), Shift\(...\) or Turn\(...\)": lambda: hook({"gain": 3}),
    r"has no parameter 'sensors\[depth\].zoom'": lambda: many(
        {f"{NAME}.zoom": Scale(Uniform(0.9, 1.1))}, seeing_toys.sensing()
    ),
    r"Camera.zoom is 1.5, but must be above 0.5 and below 1.5": lambda: seeing_toys.front_camera(zoom=1.5),
}


@pytest.mark.parametrize("sentence", REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_is_refused(sentence):
    with pytest.raises(ValueError, match=sentence):
        REFUSED[sentence]()
