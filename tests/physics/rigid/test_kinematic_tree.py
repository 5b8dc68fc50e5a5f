"""Trees and all that is computed of them: against MuJoCo's own."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trees import TREES, compiled, draw, parameters_of

from rewax.physics.rigid.kinematic_tree import TreeTopology, tree_topology


@pytest.mark.parametrize("name", TREES)
@given(seed=st.integers(0, 10**6))
def test_everything_agrees_with_mujoco(x64, name, seed):
    mj, _, everything = compiled(name)
    data, (q, v, a) = mujoco.MjData(mj), draw(mj, seed)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(mj, data)
    data.qacc[:] = a
    mass, force, bias, moved = np.zeros((mj.nv, mj.nv)), np.zeros(mj.nv), np.zeros(mj.nv), q.copy()
    mujoco.mj_fullM(mj, data, mass)
    mujoco.mj_rne(mj, data, 1, force)
    mujoco.mj_rne(mj, data, 0, bias)
    mujoco.mj_integratePos(mj, moved, v, 0.3)
    got = everything(parameters_of(mj), mj.opt.gravity, q, v, a, 0.3)
    kin = got["kinematics"]
    for ours, theirs in (
        (kin.position, data.xpos),
        (kin.rotation, data.xmat.reshape(-1, 3, 3)),
        (kin.com, data.xipos),
        (kin.inertia_rotation, data.ximat.reshape(-1, 3, 3)),
        (kin.subtree_com, data.subtree_com),
        (kin.tree_com, data.subtree_com[mj.body_rootid]),
        (kin.axes, data.cdof),
        (got["velocities"], data.cvel),
        (got["mass"], mass),
        (got["force"], force + mj.dof_armature * a),
        (got["bias"], bias),
        (got["moved"], moved),
    ):
        scale = max(np.abs(theirs).max(), 1.0)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-13 * scale)


def test_the_rounds_of_a_chain_grow_with_the_logarithm_of_its_length():
    assert [len(chain_topology(n).ancestors) for n in (1, 2, 4, 8, 16, 32)] == [0, 1, 2, 3, 4, 5]


def chain_topology(num: int) -> TreeTopology:
    return tree_topology(np.arange(num + 1) - (np.arange(num + 1) > 0), np.arange(1, num + 1), np.full(num, 3))
