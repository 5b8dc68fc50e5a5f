"""Our contact routines inside MJX: one step's acceleration is MuJoCo's, MJX stays as it was, frames."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from rewax.physics import rigid
from rewax.physics.rigid import forces
from rewax.physics.rigid.routines import contact_frame, own_routines

HEAP = """<mujoco><worldbody><geom type="plane" size="9 9 9" margin=".003"/>
<body><freejoint/><geom type="box" size=".05 .06 .07"/></body><body><freejoint/><geom type="box" size=".1 .03 .05"/></body>
<body><freejoint/><geom type="capsule" size=".04 .08"/></body><body><freejoint/><geom type="capsule" size=".03 .1"/></body>
<body><freejoint/><geom size=".06"/></body></worldbody></mujoco>"""


def test_contacts_of_all_kinds_are_mujocos(x64):
    """Planes, spheres, capsules and boxes that overlap at random: which touch, distances, points and frames."""
    mj = mujoco.MjModel.from_xml_string(HEAP)
    model, data, rng = rigid.load(mj), mujoco.MjData(mj), np.random.default_rng(0)

    @functools.partial(jax.jit, compiler_options=rigid_models.QUICK_TO_COMPILE)
    @jax.vmap
    def contacts(qpos):
        kin, state = forces.kinematics(model, qpos), rigid.initial_state(model, qpos)
        m, d = forces.mjx_data(model, kin, state, jnp.zeros(0))
        with own_routines(False):
            found = mjx.collision(m, d)._impl.contact
        return found.geom, found.dist - found.includemargin, found.dist, found.pos, found.frame

    qpos = np.tile(mj.qpos0, (40, 1)).reshape(40, 5, 7)
    qpos[:, :, :3] = rng.uniform(-0.12, 0.12, (40, 5, 3)) + [0, 0, 0.1]
    turn = rng.standard_normal((40, 5, 4))
    qpos[:, :, 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    found, kinds = [np.asarray(a) for a in contacts(qpos.reshape(40, 35))], set()
    for i, (geoms, inside, distance, point, frame) in enumerate(zip(*found, strict=True)):
        data.qpos[:] = qpos[i].ravel()
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_collision(mj, data)
        ours = np.column_stack([geoms, distance, point, frame.reshape(-1, 9)])[inside < 0]
        theirs = np.array([[*c.geom, c.dist, *c.pos, *c.frame] for c in data.contact])
        assert len(ours) == len(theirs), i
        ours, theirs = (table[np.lexsort(np.round(table, 6).T[::-1])] for table in (ours, theirs))
        np.testing.assert_allclose(ours, theirs, atol=1e-7)
        kinds |= {tuple(int(mj.geom_type[int(g)]) for g in pair) for pair in theirs[:, :2]}
    plane, sphere, capsule, box = (
        int(getattr(mujoco.mjtGeom, f"mjGEOM_{k}")) for k in ("PLANE", "SPHERE", "CAPSULE", "BOX")
    )
    assert kinds == {(plane, sphere), (plane, capsule), (plane, box), (sphere, capsule), (sphere, box), (capsule, capsule),
                     (capsule, box), (box, box)}  # fmt: skip


CUBE = """<mujoco>{}<worldbody><geom type="plane" size="9 9 9"/><body pos="0 0 .07"><freejoint/>
<geom type="box" size=".05 .06 .07"/></body></worldbody></mujoco>"""
ON_THE_FLOOR = """<mujoco><option timestep="0.004" iterations="100" ls_iterations="100" tolerance="1e-15"/><worldbody>
<geom type="plane" size="9 9 9"/><body pos="0 0 .06"><freejoint/><geom type="capsule" size=".04 .08" condim="4" friction=".7 .02 .01"/></body>
<body pos="0 0 .2"><freejoint/><geom type="box" size=".05 .06 .07" density="700"/></body></worldbody></mujoco>"""


@pytest.mark.slow
def test_a_fall_is_that_of_mujoco(x64):
    """A box onto a capsule, both tumbling, with MuJoCo's own contact law: the acceleration of steps in contact."""
    mj = mujoco.MjModel.from_xml_string(ON_THE_FLOOR)
    model, data, rng = rigid.load(mj), mujoco.MjData(mj), np.random.default_rng(0)
    states, expected, most = [], [], 0
    for _ in range(8):
        mujoco.mj_resetData(mj, data)
        data.qpos[[3, 4, 5, 6, 10, 11, 12, 13]] = rng.standard_normal(8)
        data.qvel[:] = rng.standard_normal(mj.nv)
        for step in range(90):
            mujoco.mj_step(mj, data)
            if step >= 40 and step % 10 == 0:
                mujoco.mj_forward(mj, data)
                states.append(rigid.initial_state(model, data.qpos.copy(), data.qvel.copy()))
                expected.append(data.qacc.copy())
                most = max(most, data.ncon)

    @functools.partial(jax.jit, compiler_options=rigid_models.QUICK_TO_COMPILE)
    @jax.vmap
    def accelerations(state):
        return rigid.step(model, state).qacc

    found = accelerations(jax.tree.map(lambda *a: jnp.stack(a), *states))
    error = np.abs(np.asarray(found) - expected).max(axis=1) / np.maximum(np.abs(expected).max(axis=1), 1.0)
    assert error.max() < 1e-9 and most >= 4


def test_contacts_may_be_limited_as_in_mjx_and_the_limit_lifted(x64):
    """Four corners of a cube on a plane; of these, the two deepest."""
    custom = '<custom><numeric name="max_contact_points" data="2"/></custom>'
    text = CUBE.format(custom)
    for overrides, count in (({}, 2), ({"max_contact_points": 3}, 3), ({"max_contact_points": None}, 4)):
        model = rigid.load(text, **overrides)
        state = rigid.initial_state(model, model.home.at[2].set(0.069))
        distance = jax.jit(rigid.contact_distances)(model, state)
        assert len(distance) == count
        np.testing.assert_allclose(distance, -0.001, atol=1e-12)


def test_mjx_is_as_it_was_afterwards():
    before = dict(collision_driver._COLLISION_FUNC)
    with own_routines(False):
        assert sum(collision_driver._COLLISION_FUNC[kinds] is not routine for kinds, routine in before.items()) == 7
    with own_routines(True):
        changed = [kinds for kinds, routine in before.items() if collision_driver._COLLISION_FUNC[kinds] is not routine]
    assert [tuple(map(int, kinds)) for kinds in changed] == [(0, 6)]
    with pytest.raises(RuntimeError), own_routines(False):
        raise RuntimeError
    assert before == collision_driver._COLLISION_FUNC


def test_frames_are_mujocos(x64):
    normal = np.random.default_rng(0).standard_normal((30, 3))
    normal[:3] = np.eye(3)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for ours, up in zip(np.asarray(contact_frame(jnp.asarray(normal))), normal, strict=True):
        tangent = np.array([0, 1, 0.0]) if -0.5 < up[1] < 0.5 else np.array([0, 0, 1.0])
        tangent -= up * (up @ tangent)
        tangent /= np.linalg.norm(tangent)
        np.testing.assert_allclose(ours, [up, tangent, np.cross(up, tangent)], atol=1e-12)
