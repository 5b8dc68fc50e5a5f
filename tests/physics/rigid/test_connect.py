"""Anchors of connect equalities: their acceleration at constant joint rates, by hand and by differentiating twice."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from trees import parameters_of

from rewax.physics.rigid.connect import connect_drifts
from rewax.physics.rigid.kinematic_tree import tree_topology
from rewax.physics.rigid.kinematics import integrate, kinematics
from rewax.physics.rigid.small_products import rotate

ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="arm"><joint axis="0 1 0"/><geom size=".1"/></body>
</worldbody>{}</mujoco>"""
TO_WORLD = '<equality><connect body1="arm" body2="world" anchor="0.7 0 0"/></equality>'
PAIR = """<mujoco><worldbody><body name="a" pos="0 0 1"><freejoint/><geom size=".1" pos=".05 0 .02"/>
  <body name="b" pos=".3 0 .1"><joint axis="0 1 .3"/><geom size=".1"/><site name="s" pos=".1 .2 0"/></body></body>
  <body name="c" pos="1 0 1"><joint type="ball"/><geom size=".1" pos=".2 .1 0"/><site name="t" pos="0 .1 .3"/></body>
  </worldbody><equality><connect body1="a" body2="c" anchor=".4 .1 -.2"/><connect site1="s" site2="t"/></equality></mujoco>"""


def read(text: str, flag: int = 0):
    mj = mujoco.MjModel.from_xml_string(text)
    mj.opt.disableflags |= flag
    return mj, tree_topology(mj.body_parentid, mj.jnt_bodyid, mj.jnt_type), parameters_of(mj)


@functools.cache
def program(text: str, flag: int):
    """The drifts of a model by positions, velocities and which equalities hold, compiled."""
    mj, topology, parameters = read(text, flag)

    @jax.jit
    def evaluate(qpos, qvel, active):
        kin = kinematics(topology, parameters, qpos)
        sites = None
        if mj.nsite:
            sites = kin.position[mj.site_bodyid] + rotate(kin.rotation[mj.site_bodyid], jnp.asarray(mj.site_pos))
        return connect_drifts(mj, topology, kin, qvel, jnp.asarray(mj.eq_data), active, sites)

    return mj, evaluate


def drifts(text: str, qpos, qvel, *, active=None, flag: int = 0):
    mj, evaluate = program(text, flag)
    held = np.ones(mj.neq, bool) if active is None else np.array(active)
    return evaluate(jnp.asarray(qpos, float), jnp.asarray(qvel, float), held)


def test_an_anchor_on_a_turning_arm_is_pulled_inward(x64):
    """-omega^2 r towards the hinge, wherever the arm points."""
    angle, omega = 0.4, 3.0
    outward = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    np.testing.assert_allclose(drifts(ARM.format(TO_WORLD), [angle], [omega]), -(omega**2) * 0.7 * outward, atol=1e-13)


def test_drifts_are_second_derivatives_of_the_distance_between_the_anchors(x64):
    """With constant joint rates: of two bodies that fly and turn, anchored by bodies and by sites."""
    mj, topology, parameters = read(PAIR)
    rng = np.random.default_rng(0)
    q = rng.standard_normal(mj.nq)
    mujoco.mj_normalizeQuat(mj, q)
    v = 2.0 * rng.standard_normal(mj.nv)
    a, b, c = (mj.body(name).id for name in "abc")
    ends = [(a, c, mj.eq_data[0, :3], mj.eq_data[0, 3:6]), (b, c, mj.site_pos[0], mj.site_pos[1])]

    def separations(t):
        kin = kinematics(topology, parameters, integrate(topology, jnp.asarray(q), jnp.asarray(v), t))
        place = lambda body, point: kin.position[body] + kin.rotation[body] @ jnp.asarray(point)  # noqa: E731
        return jnp.concatenate([place(i, p) - place(j, r) for i, j, p, r in ends])

    def rate(t):
        return jax.jvp(separations, (t,), (1.0,))[1]

    step = 1e-5
    differentiate = jax.jit(rate)
    expected = (differentiate(step) - differentiate(-step)) / (2 * step)
    got = drifts(PAIR, q, v)
    assert np.abs(got).min() > 0.05
    np.testing.assert_allclose(got, expected, atol=1e-7)


@pytest.mark.parametrize("active", [[True, False], [False, True], [False, False]])
def test_equalities_that_do_not_hold_have_none(x64, active):
    mj, *_ = read(PAIR)
    q, v = mj.qpos0, np.linspace(1.0, 2.0, mj.nv)
    both = np.asarray(drifts(PAIR, q, v)).reshape(2, 3)
    got = np.asarray(drifts(PAIR, q, v, active=active)).reshape(2, 3)
    np.testing.assert_array_equal(got, both * np.array(active)[:, None])
    assert np.abs(both).max(axis=1).min() > 0.1


@pytest.mark.parametrize("flag", ["mjDSBL_EQUALITY", "mjDSBL_CONSTRAINT", None])
def test_models_without_connects_have_no_rows(x64, flag):
    """None is written, or they are switched off."""
    bit = int(getattr(mujoco.mjtDisableBit, flag)) if flag else 0
    text = ARM.format(TO_WORLD if flag else "")
    assert drifts(text, [0.1], [1.0], flag=bit).shape == (0,)
    assert drifts(ARM.format(TO_WORLD), [0.1], [1.0]).shape == (3,)


def test_derivative_by_the_rate(x64):
    """Of -omega^2 r: -2 omega r."""
    f = functools.partial(drifts, ARM.format(TO_WORLD), [0.0])
    np.testing.assert_allclose(jax.jacfwd(f)(jnp.array([3.0]))[:, 0], [-2 * 3.0 * 0.7, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(jax.jacrev(f)(jnp.array([3.0]))[:, 0], [-2 * 3.0 * 0.7, 0.0, 0.0], atol=1e-12)
