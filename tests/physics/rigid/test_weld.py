"""Weld equalities and mocap bodies: MuJoCo's motion, the drift of what they hold, derivatives by the mocap pose."""

import functools
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models

from rewax.physics import rigid
from rewax.physics.rigid import forces
from rewax.xla_options import unoptimised

PULLED = """<mujoco><option timestep="0.004" iterations="100" ls_iterations="100" tolerance="1e-15" {option}/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="hand" mocap="true" pos="0 0 1"><geom type="box" size=".1 .1 .1"/></body>
  <body name="a" pos=".5 0 1"><freejoint/><geom type="box" size=".1 .2 .05"/><site name="sa" pos=".1 0 0" euler="10 20 30"/>
    <body pos="0 .3 0"><joint axis="1 0 .3" damping=".1"/><geom size=".08"/></body></body>
  <body name="b" pos="1 0 1"><freejoint/><geom type="box" size=".1 .1 .05"/><site name="sb" pos="-.1 0 .1" euler="40 20 30"/></body>
  </worldbody>
  <equality><weld body1="hand" body2="a" relpose=".3 .1 0 1 .1 .2 .3" anchor=".1 .05 0" torquescale=".7"/>
    <weld site1="sa" site2="sb"/><connect body1="a" body2="b" anchor=".2 0 0"/><weld body1="b" body2="world" active="false"/></equality>
  <keyframe><key mpos=".1 .2 1.1" mquat=".9 .1 .2 .3"/></keyframe></mujoco>"""
LED = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>
  <body name="hand" mocap="true" pos="0 0 1"/>
  <body name="a" pos=".5 0 1"><freejoint/><geom type="box" size=".1 .2 .05" pos=".05 0 0"/></body></worldbody>
  <equality><weld body1="hand" body2="a" relpose=".3 .1 0 1 .1 .2 .3" anchor=".1 .05 0" torquescale=".7" solref=".1 1"/></equality>
  </mujoco>"""
"""A body that flies alone: implicit in the velocity of its spin too."""
PUSHED = f"""<mujoco><option timestep="0.004" iterations="100" ls_iterations="100" tolerance="1e-15"/><worldbody>
  <body name="far" mocap="true" pos="0 0 9"><geom size=".1"/></body>
  <body name="fist" mocap="true" pos="-.2 0 .1"><geom size=".1" {rigid_models.SOFT}/></body>
  <body name="box" pos="0 .02 .1"><joint type="slide" axis="1 0 0"/><joint axis="0 0 1"/><geom type="box" size=".1 .1 .1" {rigid_models.SOFT}/></body>
  </worldbody></mujoco>"""


@functools.partial(jax.jit, compiler_options=unoptimised())
def guided(model, state, position, quaternion):
    return rigid.step(model.with_mocap(position, quaternion), state)


def paths(num: int, steps: int = 60):
    """Positions and quaternions, not of length 1, of mocap bodies along curves."""
    time = np.linspace(0.0, 2.0, steps)[:, None, None] + np.arange(num)[:, None]
    place = np.concatenate([np.sin(time), np.cos(2 * time), np.sin(3 * time)], axis=-1)
    turn = np.concatenate([1.0 + 0 * time, 0.3 * np.sin(time), 0.2 * np.cos(time), 0.4 * np.sin(2 * time)], axis=-1)
    return 0.1 * place, turn


@pytest.mark.parametrize("integrator", [pytest.param("Euler", marks=pytest.mark.slow), "implicitfast"])
def test_welded_bodies_follow_as_in_mujoco(x64, integrator):
    """A mocap body leads a tree that is welded to it, another body is welded to that one at sites and by a point."""
    mj = mujoco.MjModel.from_xml_string(PULLED.format(option=f'integrator="{integrator}"'))
    model, data = rigid.load(mj), mujoco.MjData(mj)
    data.qvel[:] = np.random.default_rng(0).standard_normal(mj.nv)
    state = rigid.initial_state(model, data.qpos.copy(), data.qvel.copy())
    for place, turn in zip(*paths(1), strict=True):
        data.mocap_pos[:], data.mocap_quat[:] = place + [0, 0, 1], turn
        state = guided(model, state, data.mocap_pos.copy(), data.mocap_quat.copy())
        mujoco.mj_step(mj, data)
    np.testing.assert_allclose(state.qpos, data.qpos, atol=1e-10)
    np.testing.assert_allclose(state.qvel, data.qvel, atol=1e-9)
    np.testing.assert_allclose(state.qacc, data.qacc, atol=1e-7)
    assert np.abs(data.qpos - mj.qpos0).max() > 0.1


def test_mocap_bodies_push_as_in_mujoco(x64):
    """A fist that jumps from step to step against a box; another mocap body is far away."""
    mj = mujoco.MjModel.from_xml_string(PUSHED)
    model, data = rigid.load(mj), mujoco.MjData(mj)
    state, touched = rigid.initial_state(model), 0
    for step in range(40):
        data.mocap_pos[1, 0] = -0.22 + 0.002 * step
        state = guided(model, state, data.mocap_pos.copy(), data.mocap_quat.copy())
        mujoco.mj_step(mj, data)
        touched += data.ncon > 0
    np.testing.assert_allclose(state.qpos, data.qpos, atol=1e-10)
    assert touched > 10 and data.qpos[0] > 0.01


def test_a_model_begins_where_its_keyframe_has_the_mocap_bodies(x64):
    model = rigid.load(PULLED.format(option=""))
    pose = rigid.body_poses(model, rigid.initial_state(model))
    np.testing.assert_allclose(pose.position[model.body("hand")], [0.1, 0.2, 1.1])
    moved = model.with_mocap([[1.0, 2.0, 3.0]])
    pose = rigid.body_poses(moved, rigid.initial_state(moved))
    np.testing.assert_allclose(pose.position[model.body("hand")], [1.0, 2.0, 3.0])
    expected = np.zeros(9)
    mujoco.mju_quat2Mat(expected, np.array([0.9, 0.1, 0.2, 0.3]) / np.linalg.norm([0.9, 0.1, 0.2, 0.3]))
    np.testing.assert_allclose(pose.rotation[model.body("hand")].ravel(), expected, atol=1e-12)


@pytest.mark.slow
def test_derivatives_by_mocap_poses_are_finite_differences(x64, derivatives, central_difference, random_like, inner):
    """Reverse, forward and by difference, of a state two steps later by place and turn, and by the state before."""
    model = rigid.load(LED)
    start = rigid.initial_state(model, qvel=3.0 * np.random.default_rng(0).standard_normal(model.num_dofs))
    x = (*(jnp.asarray(path[0]) for path in paths(1)), start.qpos, start.qvel)

    def end(x):
        state = start.replace(qpos=x[2], qvel=x[3])
        after = rigid.step(model.with_mocap(x[0] + jnp.array([0.0, 0.0, 1.0]), x[1]), state, num_substeps=2)
        return after.qpos, after.qvel

    move = random_like(1, x)
    quick = unoptimised()
    _, forward, weights, reverse = derivatives(end, compiler_options=quick)(x, move, lambda v: random_like(2, v))
    expected = central_difference(jax.jit(end, compiler_options=quick), x, move, 1e-6)
    for found, true in zip(forward, expected, strict=True):
        np.testing.assert_allclose(found, true, atol=1e-6 * np.abs(true).max())
    assert inner(weights, forward) == pytest.approx(inner(reverse, move), rel=1e-9)
    assert all(np.abs(leaf).max() > 1e-3 for leaf in reverse[:2])


def test_drifts_are_the_change_of_what_is_held(x64):
    """Rows of MJX times constant joint rates, a moment later less a moment before."""
    mj = mujoco.MjModel.from_xml_string(PULLED.format(option=""))
    model, qvel = rigid.load(mj), np.random.default_rng(0).standard_normal(mj.nv)

    @functools.partial(jax.jit, compiler_options=unoptimised())
    def rows(qpos):
        state = rigid.initial_state(model, qpos, qvel)
        kin = forces.kinematics(model, qpos)
        m, d = forces.mjx_data(model, kin, state, jnp.zeros(0))
        held = (mj, model.static.topology, kin, d.qvel, m.eq_data, d.eq_active)
        drift = forces.weld_drifts(*held, d.xquat, m.site_quat, d.site_xpos)
        return forces.constraint_rows(model, kin, m, d).jacobian[3:21] @ qvel, drift

    rates = []
    for time in (1e-6, -1e-6):
        qpos = mj.qpos0.copy()
        mujoco.mj_integratePos(mj, qpos, qvel, time)
        rates.append(np.asarray(rows(qpos)[0]))
    drift = rows(jnp.asarray(mj.qpos0))[1]
    np.testing.assert_allclose(drift, (rates[0] - rates[1]) / 2e-6, atol=1e-7)
    assert np.abs(drift[:12]).min() > 1e-4 and not drift[12:].any()


def test_wrong_mocap_poses_are_named():
    model = rigid.load(PUSHED)
    for call, sentence in (
        (lambda: model.with_mocap(np.zeros(3)), "position has shape (3,): give shape (2, 3) (one row per mocap body)"),
        (
            lambda: model.with_mocap(np.zeros((2, 3)), np.zeros((2, 3))),
            "quaternion has shape (2, 3): give shape (2, 4) (one row per mocap body)",
        ),
        (
            lambda: rigid.load(rigid_models.ball()).with_mocap(np.zeros((0, 3))),
            'the model has no mocap bodies: give one of the world\'s bodies mocap="true" in its MJCF',
        ),
    ):
        with pytest.raises(ValueError, match="^" + re.escape(sentence) + "$"):
            call()
