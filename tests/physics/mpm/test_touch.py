"""Forces that tools and walls feel from particles: balance of momentum, weight, patches, derivatives, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpm_bodies import DT, SIDE, cube

from rewax.physics import mpm
from rewax.physics.contact import WALLS, Collider, Overlap, Patches
from rewax.physics.mpm import Wall, WallKind, Walls
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box

MASS, GRAVITY, NUM = 1000.0 * SIDE**3, np.array([0.0, -10.0, 0.0]), 200
STEP = jax.jit(mpm.step_with_touch, static_argnames="store_every")


def pressed(num=2, start=-0.098, speed=0.0, num_substeps=NUM, **changes):
    """A cube on plates that move up, and their poses."""
    plates = tuple(
        Collider(shape=Box(half_size=(0.2, 0.05, 0.2)), friction=0.5, softness=60.0, body=k) for k in range(num)
    )
    scene, state = cube(gravity=GRAVITY, colliders=plates, **changes)
    time = DT * jnp.arange(num_substeps + 1)[:, None]
    at = jnp.stack([0.02 * jnp.arange(num) + 0.0 * time, start + speed * time + 0.0 * jnp.arange(num), 0.01 + 0.0 * time * jnp.ones(num)], -1)  # fmt: skip
    return scene, state, Pose(at, jnp.broadcast_to(jnp.eye(3), (num_substeps + 1, num, 3, 3)))


def momentum(state):
    return MASS / len(state.v) * np.asarray(state.v).sum(0)


@pytest.mark.parametrize("overlap", Overlap)
def test_forces_are_gravity_minus_the_rate_of_change_of_momentum(x64, overlap):
    """Of four plates, which a loop evaluates, two that a broad phase chooses, and walls that the cube touches too."""
    walls = Walls(lower=(Wall(position=-0.045, kind=WallKind.SEPARATING, friction=0.3), None, None), upper=(None,) * 3)
    scene, state, poses = pressed(num=4, speed=0.5, overlap=overlap, walls=walls)
    state = state.replace(v=state.v.at[:, 0].set(-0.3))
    patches = Patches(body=(0, 1, 2, 3, WALLS))
    end, felt = STEP(scene, state, poses, patches)
    expected = MASS * GRAVITY - (momentum(end) - momentum(state)) / (NUM * DT)
    np.testing.assert_allclose(felt.force.sum(0), expected, rtol=1e-10, atol=1e-10)
    assert felt.force[4, 0] < -0.1 and felt.force[0, 1] < -1.0
    near, chosen = STEP(scene.replace(max_near_colliders=2), state, poses, patches)
    rate = MASS * GRAVITY - (momentum(near) - momentum(state)) / (NUM * DT)
    np.testing.assert_allclose(chosen.force.sum(0), rate, rtol=1e-10, atol=1e-10)


def test_particles_are_those_of_a_step_without_touch():
    scene, state, poses = pressed(num=5, speed=0.5)
    end, _ = STEP(scene, state, poses, Patches(body=(0, 1, WALLS)))
    jax.tree.map(np.testing.assert_array_equal, end, jax.jit(mpm.step)(scene, state, poses))


def test_a_cube_at_rest_presses_with_its_weight_and_its_torque(x64):
    scene, state, poses = pressed(num=1, num_substeps=2000)
    settled, _ = STEP(scene, state, poses, Patches(body=(0,)))
    end, felt = STEP(scene, settled, poses, Patches(body=(0,)))
    np.testing.assert_allclose(felt.force[0], MASS * GRAVITY, atol=0.02 * MASS * 10.0)
    middle = 0.5 * np.asarray(settled.x + end.x).mean(0) - np.asarray(poses.position[0, 0])
    np.testing.assert_allclose(felt.torque[0], np.cross(middle, MASS * GRAVITY), atol=2e-3 * MASS * 10.0)


def test_patches_of_a_plate_sum_to_it(x64):
    scene, state, poses = pressed(num=1, speed=0.5)
    corners = Patches(body=(0,) * 4, center=[[-0.1, 0, -0.1], [-0.1, 0, 0.1], [0.1, 0, -0.1], [0.1, 0, 0.1]])
    _, felt = STEP(scene, state, poses, {"whole": Patches(body=(0,)), "corners": corners})
    for part, whole in zip(felt["corners"], felt["whole"], strict=True):
        np.testing.assert_allclose(part.sum(0), whole[0], rtol=1e-10)
    assert np.all(felt["corners"].force[:, 1] < -0.01)


def test_the_derivative_of_forces_is_exact(x64, random_like, derivatives_agree):
    """Of a cube that slides: where nothing slides, friction has a kink."""
    scene, state, poses = pressed(num=1, speed=0.5, num_substeps=8)
    state = state.replace(v=state.v + 0.3 * random_like(2, state.v) + jnp.array([0.4, 0.0, 0.2]))
    patches = Patches(body=(0, 0), center=[[0.1, 0, 0.01], [-0.13, 0, 0]])

    def felt(given):
        scene_, state_, height = given
        moved = poses._replace(position=poses.position + jnp.array([0.0, 1.0, 0.0]) * height)
        return mpm.step_with_touch(scene_, state_, moved, patches)[1]

    at = (scene, state, jnp.asarray(0.0))
    dx = jax.tree.map(jnp.zeros_like, at)
    dx = (dx[0].replace(particle_volume=1e-3 * scene.particle_volume), random_like(0, state), jnp.asarray(0.1))
    dx = (dx[0], jax.tree.map(lambda a: 1e-3 * a, dx[1]), 1e-3 * dx[2])
    value, _ = derivatives_agree(felt, at, dx, step=1e-4, bar=1e-6, exact=1e-9)
    assert np.abs(value.force).max() > 0.1


def test_a_batch_is_its_elements_one_by_one():
    scene, state, poses = pressed(num=1, speed=0.5, num_substeps=20)
    heights = jnp.array([0.0, 0.002])

    def felt(height):
        return mpm.step_with_touch(scene, state.replace(x=state.x.at[:, 1].add(height)), poses, Patches(body=(0,)))[1]

    together, one = jax.jit(jax.vmap(felt))(heights), jax.jit(felt)
    for k, height in enumerate(heights):
        for a, b in zip(together, one(height), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-4, atol=1e-5)


def test_a_body_without_a_pose_feels_nothing():
    scene, state, poses = pressed(num=1, num_substeps=2)
    with pytest.raises(ValueError, match="a patch belongs to body 1, but there are 1 bodies"):
        mpm.step_with_touch(scene, state, poses, Patches(body=(1,)))
