"""Tasks on cloth and ropes: held vertices and grasps follow the joints, and mistakes are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax import struct
from rewax.envs.kit import PointCloud, ThinTask
from rewax.envs.kit.task_repr import task_repr
from rewax.envs.kit.two_hands import TwoHands, hands_at
from rewax.physics import thin
from rewax.physics.contact import Patches

MESH = thin.sheet(0.2, 0.2, 2, 2)
CLOTH = thin.isotropic_cloth(youngs_modulus=2e4, poissons_ratio=0.3, thickness=2e-3, density=200.0, damping=1e-4)


@struct.dataclass
class Lift(TwoHands):
    """Two hands hold the corners 0 and 2."""

    def reward(self, physics):
        height = physics.soft.x[:, 1].mean()
        return height, {"height": height}


def lift(kind=Lift, **changes):
    grasps = hands_at(MESH, (0, 2), radius=0.05, stiffness=50.0)
    options = {
        "scene": thin.make_scene(mesh=MESH, dt=2e-3, cloth=CLOTH, grasps=grasps, drag=1.0),
        "rest_positions": MESH.vertices,
        "corners": (0, 2),
        "joint_start": (0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 1.0),
        "joint_lower": (-1.0,) * 6 + (0.0,),
        "joint_upper": (1.0,) * 7,
        "joint_step": (0.01,) * 6 + (0.5,),
        "rate": 200.0,
        "cloud": PointCloud(num_points=9),
        "num_substeps": 10,
        "max_steps": 30,
    }
    return kind(**(options | changes))


def test_hands_hold_until_they_open():
    env = lift()
    state = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_allclose(state.physics.joint_q, env.joint_start, atol=1e-6)
    step, up = jax.jit(env.step), jnp.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    open_hands = jnp.array([0.0] * 6 + [-1.0])
    for _ in range(15):
        state = step(state, up)
    corners = state.physics.soft.x[jnp.array([0, 2])]
    np.testing.assert_allclose(corners, [[0.0, 0.15, 0.0], [0.0, 0.15, 0.2]], atol=0.02)
    assert float(state.physics.soft.x[8, 1]) < 0.1  # the other edge hangs
    assert state.obs["vector"].shape == (33,) and int(state.status) == 0
    for _ in range(8):
        state = step(state, open_hands)
    assert float(state.physics.joint_q[6]) == pytest.approx(0.0, abs=1e-3)
    assert float(corners[:, 1].min() - state.physics.soft.x[jnp.array([0, 2]), 1].max()) > 0.03  # it falls


def test_what_is_missing_is_named():
    grasping = lift().scene
    bare = {"rest_positions": MESH.vertices, "cloud": PointCloud(num_points=9), "num_substeps": 2, "max_steps": 3}
    held = ThinTask(scene=thin.make_scene(mesh=MESH, dt=2e-3, cloth=CLOTH, held=[0]), **bare)
    with pytest.raises(NotImplementedError, match=r"holds vertices but has no pins\(physics, joint_q\): define it"):
        held.pins(None, jnp.zeros((2, 0)))
    with pytest.raises(NotImplementedError, match=r"has grasps but no grips\(joint_q\): define it"):
        ThinTask(scene=grasping, **bare).grips(jnp.zeros((2, 0)))
    with pytest.raises(ValueError, match="touch is given, but colliders feel no force of cloth and ropes"):
        held.replace(touch={"fingers": Patches(body=(0,))})
    with pytest.raises(ValueError, match="list_every is 2, but only tasks of particles alone use it: leave it out"):
        held.replace(list_every=2)


def test_pictures_sensors_and_text_know_it():
    env = lift()
    physics = env.reset(jax.random.key(0)).physics
    looks = env.appearance
    assert looks["material_names"] == ("cloth",) and looks["thickness"] == env.thickness
    np.testing.assert_array_equal(looks["triangles"], MESH.triangles)
    world = env.world(physics, env.up)
    assert world.names == ("cloth",) and len(world.triangles[0].faces) == 8
    np.testing.assert_array_equal(world.body(1).rotation, np.eye(3))  # hands without colliders carry cameras, too
    centers = [np.asarray(drawing["center"]) for drawing in env.render_shapes(physics)]
    np.testing.assert_allclose(centers, np.asarray(physics.soft.x)[[0, 2]], atol=1e-6)
    assert "9 vertices, 8 triangles" in task_repr(env)
