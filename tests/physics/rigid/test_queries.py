"""What can be asked of a state: against MuJoCo, and pictures of every kind of geom."""

import functools

import jax
import mujoco
import numpy as np
import pytest
from rigid_cases import draw, home, loaded

from rewax.physics import rigid
from rewax.status import Status


@functools.cache
def measuring():
    """All that can be asked about a state, as one program."""

    @jax.jit
    def measure(model, state):
        return (
            rigid.body_poses(model, state),
            rigid.geom_poses(model, state),
            rigid.body_velocities(model, state),
            rigid.centers_of_mass(model, state),
            rigid.contact_distances(model, state),
            rigid.check_status(state),
        )

    return measure


def test_what_is_measured_agrees_with_mujoco(x64):
    """Poses of bodies and geoms, velocities of origins, centres of mass, distances, at the state and not before it."""
    mj, model = loaded("contraption")
    qpos, (qvel, *_) = home(mj), draw(mj, speed=1.0)
    bodies, geoms, (velocity, turning), centers, distances, status = measuring()(
        model, rigid.initial_state(model, qpos, qvel)
    )
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(mj, data)
    np.testing.assert_allclose(bodies.position, data.xpos, atol=1e-14)
    np.testing.assert_allclose(bodies.rotation, data.xmat.reshape(-1, 3, 3), atol=1e-14)
    np.testing.assert_allclose(geoms.position, data.geom_xpos, atol=1e-14)
    np.testing.assert_allclose(geoms.rotation, data.geom_xmat.reshape(-1, 3, 3), atol=1e-14)
    np.testing.assert_allclose(centers, data.subtree_com, atol=1e-14)
    both = np.zeros((mj.nbody, 6))
    for body in range(mj.nbody):
        mujoco.mj_objectVelocity(mj, data, mujoco.mjtObj.mjOBJ_XBODY, body, both[body], 0)
    np.testing.assert_allclose(np.concatenate([turning, velocity], axis=1), both, atol=1e-13)
    # Of pairs that touch; sorted, as the order of contacts is MJX's own.
    near = np.sort([contact.dist for contact in data.contact])
    np.testing.assert_allclose(np.sort(np.asarray(distances))[: len(near)], near, atol=1e-14)
    assert int(status) == Status.OK
    assert (model.num_positions, model.num_dofs, model.num_actuators, model.num_bodies) == (
        mj.nq,
        mj.nv,
        mj.nu,
        mj.nbody,
    )
    assert model.dt == mj.opt.timestep
    np.testing.assert_array_equal(model.home, mj.key_qpos[0])
    np.testing.assert_array_equal(loaded("ball")[1].home, loaded("ball")[0].qpos0)


ALL_KINDS = """<mujoco><worldbody><geom type="plane" size="1 1 1" pos="0 0 -1" quat="0.7071068 0.7071068 0 0"/>
  <body pos="1 2 3" quat="0 1 0 0"><freejoint/><geom type="sphere" size=".2" pos=".1 0 .5"/>
    <geom type="capsule" size=".1 .3" quat="0.7071068 0 0.7071068 0"/><geom type="cylinder" size=".05 .4" pos="0 1 0"/>
    <geom type="box" size=".1 .2 .3"/><geom type="ellipsoid" size=".1 .2 .4"/></body></worldbody></mujoco>"""


def test_pictures_of_every_kind_of_geom():
    """Of a body turned by half a turn about x."""
    model = rigid.load(ALL_KINDS)
    kinds = []

    @jax.jit
    def numbers(state):
        found = rigid.shapes(model, state)
        kinds.extend(shape.pop("kind") for shape in found)
        return found

    plane, sphere, capsule, cylinder, box, ellipsoid = numbers(rigid.initial_state(model))
    assert kinds == [
        "plane",
        "sphere",
        "capsule",
        "cylinder",
        "box",
        "ellipsoid",
    ]
    place = [next(value for key, value in s.items() if key.startswith("cent")) for s in (plane, sphere, cylinder)]
    np.testing.assert_allclose(place, [[0, 0, -1], [1.1, 2, 2.5], [1, 1, 3]], atol=1e-6)
    for shape, direction in ((plane, [0, -1, 0]), (capsule, [1, 0, 0]), (cylinder, [0, 0, -1])):
        np.testing.assert_allclose(shape["direction"], direction, atol=1e-6)
    assert float(sphere["radius"]) == pytest.approx(0.2)
    assert (float(capsule["radius"]), float(capsule["half_length"])) == pytest.approx((0.1, 0.3))
    assert (float(cylinder["radius"]), float(cylinder["half_length"])) == pytest.approx((0.05, 0.4))
    for shape in (box, ellipsoid):
        np.testing.assert_allclose(shape["rotation"], np.diag([1, -1, -1]), atol=1e-6)
    np.testing.assert_allclose(ellipsoid["semi_axes"], [0.1, 0.2, 0.4], rtol=1e-6)
    size = next(value for key, value in box.items() if key.startswith("half_size"))
    np.testing.assert_allclose(size, [0.1, 0.2, 0.3], rtol=1e-6)


WEDGES = """<mujoco><asset><mesh name="first" vertex="1 1 -1 1 0 0 0 1 0 0 0 1 0 0 0"/>
  <mesh name="second" vertex="0 0 0 .2 0 0 0 .4 0 0 0 .6 .2 .4 .6"/></asset><worldbody>
  <body pos="1 2 3"><freejoint/><geom type="mesh" mesh="second" pos=".1 0 0" contype="0" conaffinity="0"/></body>
  <body pos="0 0 9"><freejoint/><geom type="mesh" mesh="first" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""


def test_meshes_are_drawn_where_the_model_has_their_vertices():
    """MuJoCo moves meshes to their own middle and axes of inertia; what is drawn is back where the MJCF has it."""
    model = rigid.load(WEDGES)
    state = rigid.initial_state(model)
    second, first = rigid.shapes(model, state)
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.4, 0], [0, 0, 0.6], [0.2, 0.4, 0.6]]) + [1.1, 2.0, 3.0]
    others = np.array([[0, 0, 0], [1, 1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + [0, 0, 9]
    for shape, expected in ((second, corners), (first, others)):
        assert shape["kind"] == "mesh"
        points = np.asarray(shape["center"]) + shape["vertices"] @ np.asarray(shape["rotation"]).T
        order = [np.lexsort(np.round(p, 4).T) for p in (points, expected)]
        np.testing.assert_allclose(points[order[0]], expected[order[1]], atol=1e-5)
        a, b, c = (shape["vertices"][shape["triangles"][:, i]] for i in range(3))
        assert np.einsum("ni,ni->n", a, np.cross(b, c)).sum() > 0.0  # counter-clockwise from outside
        edges = np.sort(shape["triangles"][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)  # closed
    assert rigid.shapes(model, state)[0]["vertices"] is second["vertices"]


def test_velocities_of_a_body_that_flies_and_turns(x64):
    """A free joint's velocity is in the world, its angular velocity in the body's frame."""
    model = rigid.load(ALL_KINDS)
    state = rigid.initial_state(model, qvel=[1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    velocity, turning = jax.jit(rigid.body_velocities)(model, state)
    np.testing.assert_allclose(velocity[1], [1.0, 2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(turning[1], [0.1, -0.2, -0.3], atol=1e-12)
    np.testing.assert_array_equal(velocity[0], 0.0)


def test_geoms_that_mujocos_viewer_hides_are_drawn_where_a_body_has_no_others():
    model = rigid.load("""<mujoco><worldbody>
      <body><freejoint/><geom size="0.1" group="3"/><geom type="box" size="1 1 1" contype="0" conaffinity="0"/></body>
      <body pos="0 0 9"><freejoint/><geom type="capsule" size="0.1 0.2" group="4"/></body>
      </worldbody></mujoco>""")
    assert [drawing["kind"] for drawing in rigid.shapes(model, rigid.initial_state(model))] == ["box", "capsule"]
