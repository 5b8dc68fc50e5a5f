"""Contacts that rewax finds itself: MuJoCo's, of all kinds; a fall is MuJoCo's; the public check passes them."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics import rigid
from rewax.physics.rigid import forces
from rewax.physics.rigid.built_in_pairs import BUILT_IN_PAIRS, UNDER_A_PENALTY
from rewax.physics.rigid.collide import collide
from rewax.testing import check_contact_pair
from rewax.xla_options import unoptimised

HEAP = """<mujoco><worldbody><geom type="plane" size="9 9 9" margin=".003"/>
<body><freejoint/><geom type="box" size=".05 .06 .07"/></body><body><freejoint/><geom type="box" size=".1 .03 .05"/></body>
<body><freejoint/><geom type="capsule" size=".04 .08"/></body><body><freejoint/><geom type="capsule" size=".03 .1"/></body>
<body><freejoint/><geom size=".06"/></body></worldbody></mujoco>"""


def test_contacts_of_all_kinds_are_mujocos(x64):
    """Planes, spheres, capsules and boxes that overlap at random: which touch, distances, points and frames."""
    mj = mujoco.MjModel.from_xml_string(HEAP)
    model, data, rng = rigid.load(mj), mujoco.MjData(mj), np.random.default_rng(0)

    @functools.partial(jax.jit, compiler_options=unoptimised())
    @jax.vmap
    def contacts(qpos):
        kin, state = forces.kinematics(model, qpos), rigid.initial_state(model, qpos)
        m, d = forces.mjx_data(model, kin, state, jnp.zeros(0))
        found = collide(model.static.collisions, m, d)
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

    @functools.partial(jax.jit, compiler_options=unoptimised())
    @jax.vmap
    def accelerations(state):
        return rigid.step(model, state).qacc

    found = accelerations(jax.tree.map(lambda *a: jnp.stack(a), *states))
    error = np.abs(np.asarray(found) - expected).max(axis=1) / np.maximum(np.abs(expected).max(axis=1), 1.0)
    assert error.max() < 1e-9 and most >= 4


SLOW = (("capsule", "capsule"), ("capsule", "box"), ("box", "box"), ("sphere", "capsule"))
"""To compile."""


@pytest.mark.parametrize(
    "pair",
    [
        pytest.param(pair, marks=[pytest.mark.slow] * (pair.kinds in SLOW), id="-".join(pair.kinds))
        for pair in BUILT_IN_PAIRS
    ],
)
def test_the_public_check_passes_them(pair):
    check_contact_pair(pair)


def test_one_table_says_what_is_ours():
    kinds = [pair.kinds for pair in BUILT_IN_PAIRS]
    assert len(set(kinds)) == len(kinds) == 7
    assert [pair.kinds for pair in UNDER_A_PENALTY] == [("plane", "box")]
    world = "".join(
        f'<body><freejoint/><geom type="{k}" size=".1 .1 .1"/></body>' for k in ("sphere", "capsule", "box") * 2
    )
    text = f'<mujoco><worldbody><geom type="plane" size="9 9 9"/>{world}</worldbody></mujoco>'
    for penalty, ours in ((None, {*kinds}), (rigid.Penalty(stiffness=1e3), {("plane", "box")})):
        found = rigid.load(text, dt=1e-3, penalty=penalty).static.collisions
        functions = dict(zip((group.kinds for group in found.groups), found.functions, strict=True))
        assert {pair for pair, function in functions.items() if function is not None} == ours and len(functions) == 9
