"""Tasks on particles and cloth: points, observations, pictures and sensors hold both; grasps follow bodies."""

import jax
import jax.numpy as jnp
import numpy as np
from mixed_bodies import SPACING, cloth_scene, law_of, sand_scene

from rewax import struct
from rewax.envs.kit import MixedTask, PointCloud, reset_noise
from rewax.envs.kit.task_repr import task_repr
from rewax.physics import coupling, thin
from rewax.physics.contact import Collider
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box, Sphere, fill_box
from rewax.physics.thin import Grasp

MESH = thin.sheet(0.1, 0.1, 2, 2)
GRAINS = np.asarray(fill_box((0.05, 0.01, 0.05), (0.025, 0.0125, 0.025), SPACING))


@struct.dataclass
class Tray(MixedTask):
    """A cloth in a hand at each corner: one body, which the joint lifts, with grains on it."""

    def poses(self, joint_q):
        hand = joint_q * jnp.array([0.0, 1.0, 0.0])
        position = jnp.stack([hand, jnp.zeros_like(hand)], axis=1)
        return Pose(position, jnp.broadcast_to(jnp.eye(3, dtype=hand.dtype), (*position.shape, 3)))

    def grips(self, joint_q):
        return jnp.ones((len(joint_q), 1), joint_q.dtype)

    def reward(self, physics):
        height = physics.soft.particles.x[:, 1].mean()
        return height, {"cloth": physics.soft.thin.x[:, 1].mean()}


def tray(**changes):
    floor = (Collider(shape=Box(half_size=(0.1, 0.01, 0.1)), body=1, offset=(0.0, -0.05, 0.0), friction=0.4),)
    corners = Grasp(body=0, vertices=(0, 2, 6, 8), stiffness=50.0, damping=5e-3)
    scene = coupling.make_mixed_scene(
        particles=sand_scene(colliders=floor),
        thin=cloth_scene(MESH, grasps=(corners,), drag=1.0),
        contact=law_of(),
        vertices=MESH.vertices,
    )
    options = {
        "scene": scene,
        "rest_positions": np.concatenate([GRAINS, MESH.vertices]),
        "noise": reset_noise((-0.01, 0.0, -0.01), (0.01, 0.0, 0.01)),
        "joint_start": (0.0,),
        "joint_lower": (0.0,),
        "joint_upper": (0.05,),
        "joint_step": (2e-3,),
        "cloud": PointCloud(num_points=8, stride=3),
        "vertex_stride": 4,
        "num_substeps": 50,
        "max_steps": 10,
    }
    return Tray(**(options | changes))


ENV = tray()
RESET = jax.jit(ENV.reset)


def test_hands_lift_cloth_and_grains():
    state, step = RESET(jax.random.key(0)), jax.jit(ENV.step)
    before = state.physics.soft
    np.testing.assert_allclose(
        np.ptp(np.asarray(before.particles.x - ENV.rest_positions[: len(GRAINS)]), axis=0), 0, atol=1e-6
    )
    shift = np.asarray(before.thin.x - MESH.vertices)
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-6)
    assert 1e-4 < np.abs(shift[0, [0, 2]]).max() <= 0.01
    for _ in range(10):
        state = step(state, jnp.ones(1))
    after = state.physics.soft
    corners = np.asarray(after.thin.x - before.thin.x)[[0, 2, 6, 8]]
    np.testing.assert_allclose(corners[:, 1], 0.02, atol=4e-3)
    assert int(state.status) == 0 and bool(state.truncated)
    fallen = before.particles.x[:, 1] - 0.5 * 9.81 * (10 * ENV.control_dt) ** 2
    assert float((after.particles.x[:, 1] - fallen).mean()) > 2e-3  # the cloth carries them, although it sags
    assert float(after.particles.x[:, 1].min()) > float(after.thin.x[:, 1].min())


def test_observations_and_text_hold_both():
    state = RESET(jax.random.key(0))
    np.testing.assert_array_equal(state.obs["particle_q"], state.physics.soft.particles.x[::3][:8])
    np.testing.assert_array_equal(state.obs["cloth_q"], state.physics.soft.thin.x[::4])
    assert state.obs["vector"].shape == (2,) and ENV.num_particles == len(GRAINS)
    assert f"{len(GRAINS)} particles, 9 vertices, 8 triangles" in task_repr(ENV)


def test_pictures_and_sensors_hold_both():
    physics, looks = RESET(jax.random.key(0)).physics, ENV.appearance
    assert looks["material_names"] == ("cloth", "sand") and looks["thickness"] == ENV.thickness
    np.testing.assert_array_equal(looks["materials"], [1] * len(GRAINS) + [0] * 9)
    np.testing.assert_array_equal(looks["triangles"], MESH.triangles + len(GRAINS))
    shown = np.asarray(ENV.particles(physics))
    np.testing.assert_array_equal(shown[len(GRAINS) :], physics.soft.thin.x)
    assert ENV.particle_values(physics)["speed"].shape == (len(shown),)
    kinds = [drawing["kind"] for drawing in ENV.render_shapes(physics)]
    assert kinds == ["box", "sphere"]  # the floor, and the one grasp
    world = ENV.world(physics, ENV.up)
    assert set(world.names) >= {"sand", "cloth"} and len(world.balls[0].center) == len(GRAINS)
    assert [world.body(k).position.shape for k in (0, 1)] == [(3,)] * 2


def test_tools_of_the_cloth_alone_are_seen():
    """And those of the particles once, also where the cloth meets them, too."""
    ball, box = (Collider(shape=Sphere(radius=0.01), body=body, friction=0.4) for body in (0, 1))
    env = tray()
    env = env.replace(scene=env.scene.replace(thin=env.scene.thin.replace(colliders=(ball, box))))
    assert [collider.body for collider in env.seen_colliders] == [1, 0]
    physics = RESET(jax.random.key(0)).physics
    assert [drawing["kind"] for drawing in env.render_shapes(physics)] == ["box", "sphere", "sphere"]
    assert len(env.world(physics, env.up).solids) == len(ENV.world(physics, ENV.up).solids) + 1
