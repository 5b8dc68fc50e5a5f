"""Geoms as colliders: MuJoCo's distances, poses of its bodies, what cannot be one."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics import rigid
from rewax.physics.contact import shape_pose
from rewax.physics.numerics.pose import body_pose
from rewax.physics.shapes import signed_distance

TOOLS = """
<mujoco><asset><mesh name="wedge" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/></asset><worldbody>
  <geom name="floor" type="plane" size="1 1 .1"/>
  <body name="arm" pos=".1 .2 .3" euler="10 20 30"><joint axis="0 1 0"/>
    <geom name="ball" type="sphere" size=".1" pos=".1 0 0" friction=".7"/>
    <geom name="bar" type="capsule" size=".05 .2" pos="0 .2 0" euler="40 0 10"/>
    <body name="tip" pos="0 0 .4"><joint type="slide" axis="1 0 0"/>
      <geom name="brick" type="box" size=".05 .1 .15" euler="0 50 0"/>
      <geom name="can" type="cylinder" size=".06 .1" pos="0 .3 0" euler="30 0 0"/>
      <geom name="egg" type="ellipsoid" size=".05 .08 .1" pos="0 0 .3"/>
      <geom name="ghost" size=".1" contype="0" conaffinity="0"/>
    </body>
  </body>
</worldbody></mujoco>
"""
QPOS = np.array([0.4, 0.15])


@pytest.fixture(scope="module")
def model():
    return rigid.load(
        TOOLS.replace('<asset><mesh name="wedge" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/></asset>', ""), dt=1e-3
    )


def is_tool(body, geom):
    return geom not in ("floor", "ghost")


def test_colliders_have_mujocos_distances(model):
    """From points anywhere, as the distance that MuJoCo finds between a tiny sphere there and the geom."""
    tools = rigid.colliders(model, chosen=is_tool)
    assert [tool.body for tool in tools] == [1, 1, 2, 2, 2]
    poses = rigid.poses(model, jnp.asarray(QPOS, jnp.float32))
    points = np.random.default_rng(0).uniform(-0.4, 0.9, (12, 3))
    probes = "".join(
        f'<geom name="p{i}" type="sphere" size="1e-4" pos="{" ".join(map(str, p))}"/>' for i, p in enumerate(points)
    )
    text = TOOLS.replace("<worldbody>", f"<worldbody>{probes}").replace(
        '<geom name="floor" type="plane" size="1 1 .1"/>', ""
    )
    mj = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(mj)
    data.qpos[:] = QPOS
    mujoco.mj_forward(mj, data)

    @jax.jit
    def distances(points):
        placed = [shape_pose(tool, body_pose(poses, tool.body)) for tool in tools]
        local = [(points - pose.position) @ pose.rotation for pose in placed]
        return [signed_distance(tool.shape, where)[0] for tool, where in zip(tools, local, strict=True)]

    every = np.asarray(distances(jnp.asarray(points, jnp.float32)))
    for found, name in zip(every, ("ball", "bar", "brick", "can", "egg"), strict=True):
        expected = [
            mujoco.mj_geomDistance(mj, data, mj.geom(f"p{i}").id, mj.geom(name).id, 10.0, None) + 1e-4
            for i in range(len(points))
        ]
        outside = np.asarray(expected) > 0.02
        assert outside.sum() >= 6
        np.testing.assert_allclose(found[outside], np.asarray(expected)[outside], atol=2e-3 if name == "egg" else 2e-5)


def test_friction_is_the_geoms_or_the_given_one(model):
    own, given = (rigid.colliders(model, chosen=is_tool, friction=f, softness=50.0) for f in (None, 0.2))
    np.testing.assert_allclose([t.friction for t in own], [0.7, 1.0, 1.0, 1.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose([t.friction for t in given], 0.2, rtol=1e-6)
    np.testing.assert_allclose([t.softness for t in given], 50.0)


def test_poses_are_those_of_the_bodies_for_any_shape_of_angles(model):
    many = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (2, 3, 2)), jnp.float32)

    @jax.jit
    def many_and_one(many):
        return rigid.poses(model, many), rigid.body_poses(model, rigid.initial_state(model, many[1, 2]))

    found, one = many_and_one(many)
    assert found.position.shape == (2, 3, 3, 3) and found.rotation.shape == (2, 3, 3, 3, 3)
    np.testing.assert_allclose(found.position[1, 2], one.position, atol=1e-6)
    np.testing.assert_allclose(found.rotation[1, 2], one.rotation, atol=1e-6)


def test_poses_and_shapes_can_be_differentiated(x64):
    model = rigid.load(
        TOOLS.replace('<asset><mesh name="wedge" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/></asset>', ""), dt=1e-3
    )

    def height(qpos, size):
        changed = model.replace(parameters={**model.parameters, "geom_size": size})
        brick = rigid.colliders(changed, chosen=lambda body, geom: geom == "brick")[0]
        pose = shape_pose(brick, body_pose(rigid.poses(changed, qpos), brick.body))
        return signed_distance(brick.shape, pose.rotation.T @ (jnp.array([0.3, 0.9, 0.9]) - pose.position))[0]

    point, size = jnp.asarray(QPOS), model.parameters["geom_size"]
    both = jax.jit(jax.value_and_grad(height, argnums=(0, 1)))
    _, (slope, by_size) = both(point, size)
    for i, step in enumerate(1e-6 * np.eye(2)):
        difference = (both(point + step, size)[0] - both(point - step, size)[0]) / 2e-6
        np.testing.assert_allclose(slope[i], difference, rtol=1e-6)
    brick = model.static.mj.geom("brick").id
    assert np.abs(by_size[brick]).max() > 0.1 and np.abs(by_size).sum() == pytest.approx(np.abs(by_size[brick]).sum())


def test_a_mesh_is_baked():
    text = TOOLS.replace(
        '<geom name="ghost" size=".1" contype="0" conaffinity="0"/>',
        '<geom name="wedge" type="mesh" mesh="wedge" pos=".4 0 0"/>',
    )
    model = rigid.load(text.replace('<geom name="floor" type="plane" size="1 1 .1"/>', ""), dt=1e-3)
    with pytest.raises(
        ValueError, match=r"^geom 'wedge' is a mesh: give mesh_spacing, the spacing of its baked grid in m$"
    ):
        rigid.colliders(model)
    (tool,) = rigid.colliders(model, mesh_spacing=0.005, chosen=lambda body, geom: geom == "wedge")
    pose = shape_pose(tool, body_pose(rigid.poses(model, jnp.zeros(2)), tool.body))
    tip = rigid.body_poses(model, rigid.initial_state(model, np.zeros(2)))
    corner = tip.position[2] + tip.rotation[2] @ jnp.array([0.42, 0.02, 0.02])  # inside, near the right angle

    def distance(point):
        return float(signed_distance(tool.shape, pose.rotation.T @ (point - pose.position))[0])

    assert distance(corner) == pytest.approx(-0.02, abs=5e-3)
    assert distance(tip.position[2] + tip.rotation[2] @ jnp.array([0.4, 0.0, -0.03])) == pytest.approx(0.03, abs=5e-3)


def test_a_plane_is_no_collider(model):
    with pytest.raises(
        ValueError, match=r"^geom 'floor' is a plane, which is no collider: leave it out with chosen=\.\.\., "
    ):
        rigid.colliders(model)


def test_geoms_of_explicit_pairs_are_colliders():
    """As in the example of docs/rigid.md, where geoms touch by pairs alone."""
    mjcf = """
    <mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
      <geom name="table" type="box" size="1 1 .1"/>
      <body pos="0 0 .3"><freejoint/><geom name="ball" size=".1"/><geom name="ghost" size=".2" mass="0"/></body>
    </worldbody><contact><pair geom1="table" geom2="ball"/></contact></mujoco>
    """
    assert [type(tool.shape).__name__ for tool in rigid.colliders(rigid.load(mjcf))] == ["Box", "Sphere"]
