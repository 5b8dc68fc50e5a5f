"""Evaluating only the nearest colliders changes nothing, and tells when it would."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import mpm
from rewax.physics.contact.broad_phase import near_colliders
from rewax.physics.contact.colliders import Collider, apply_colliders, place
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.laws import Hencky
from rewax.physics.mpm.materials import Material
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Box, Sphere
from rewax.physics.shapes.sampling import fill_box
from rewax.status import Status

NUM_SUBSTEPS = 4
BODIES = jnp.array(
    [[0.25, 0.41, 0.3], [0.8, 0.9, 0.8], [0.35, 0.41, 0.3], [0.8, 0.1, 0.8], [0.3, 0.41, 0.35], [0.1, 0.9, 0.8]]
)


def collider(shape, body):
    return Collider(
        shape=shape,
        offset=jnp.zeros(3),
        rotation=jnp.eye(3),
        friction=jnp.asarray(0.4),
        softness=jnp.asarray(60.0),
        body=body,
    )


@pytest.fixture(scope="module")
def scene_and_state():
    """Four balls, of which two are near, and two boxes, of which one is; they overlap, so that their order counts."""
    x = fill_box((0.3, 0.3, 0.3), (0.2, 0.2, 0.2), 0.05)
    colliders = (
        *(collider(Sphere(radius=jnp.asarray(r)), b) for b, r in enumerate((0.05, 0.04, 0.045, 0.05))),
        *(collider(Box(half_size=jnp.full(3, r)), b) for b, r in ((4, 0.04), (5, 0.03))),
    )
    scene = mpm.make_scene(
        grid=Grid(shape=(9, 9, 9), spacing=0.1), dt=1e-3, particle_volume=0.2**3 / len(x), colliders=colliders,
        material=Material(density=1e3, elasticity=Hencky(youngs_modulus=1e3, poissons_ratio=0.3)),
    )  # fmt: skip
    return scene, mpm.initial_state(jnp.asarray(x), scene)


def poses(push=-0.5):
    t = jnp.arange(NUM_SUBSTEPS + 1)[:, None, None] * 1e-3
    position = BODIES[None] + t * jnp.array([0.3, push, 0.0])
    return Pose(position, jnp.broadcast_to(jnp.eye(3), (*position.shape[:2], 3, 3)))


def test_value_and_gradient_are_those_of_all_colliders(scene_and_state):
    """At the nodes around the particles, with respect to the velocity of the bodies."""
    scene, state = scene_and_state
    lower, upper = jnp.min(state.x, axis=0) - 0.15, jnp.max(state.x, axis=0) + 0.15
    nodes = cp.split_vector(jnp.asarray(np.random.default_rng(0).uniform(lower, upper, (2000, 3)), jnp.float32))
    weights = jax.random.normal(jax.random.key(0), (3, 2000))

    @functools.partial(jax.jit, static_argnames="max_near")
    def value_and_slope(push, max_near):
        def loss(push):
            before, after = (jax.tree.map(lambda p, t=t: p[t], poses(push)) for t in (0, 1))
            placed = place(scene.colliders, before, after, scene.dt)
            near = near_colliders(scene.colliders, placed, lower, upper, max_near)
            v = jnp.stack(apply_colliders(near, nodes, tuple(jnp.ones((3, 2000)))))
            return jnp.sum(weights * v), v

        return jax.value_and_grad(loss, has_aux=True)(push)

    (_, every), slope = value_and_slope(-0.5, 6)
    (_, near), slope_near = value_and_slope(-0.5, 2)
    np.testing.assert_allclose(near, every, atol=1e-6)
    assert np.mean(np.any(every != 1.0, axis=0)) > 0.02 and abs(float(slope)) > 0.1
    np.testing.assert_allclose(slope_near, slope, rtol=1e-4)
    # With one of each run something is missing.
    assert float(jnp.abs(value_and_slope(-0.5, 1)[0][1] - every).max()) > 1e-2


@pytest.mark.slow
def test_a_step_uses_the_nearest_and_tells_when_more_are_near(scene_and_state):
    scene, state = scene_and_state
    step = jax.jit(mpm.step)
    near, one = (scene.replace(max_near_colliders=n) for n in (2, 1))
    end, end_near = step(scene, state, poses()), step(near, state, poses())
    np.testing.assert_allclose(end_near.v, end.v, atol=1e-6)
    assert float(jnp.abs(end.v[:, 0]).max()) > 1e-3  # something was pushed
    assert int(mpm.check_status(near, end, start=state, poses=poses())) == 0
    assert int(mpm.check_status(one, end, start=state, poses=poses())) == Status.FAR_COLLIDERS


def test_at_least_one():
    with pytest.raises(ValueError, match="max_near_colliders is 0: give at least 1"):
        mpm.make_scene(
            grid=Grid(shape=(9, 9, 9), spacing=0.1), dt=1e-3, particle_volume=1e-3, max_near_colliders=0,
            material=Material(density=1e3, elasticity=Hencky(youngs_modulus=1e3, poissons_ratio=0.3)),
        )  # fmt: skip
