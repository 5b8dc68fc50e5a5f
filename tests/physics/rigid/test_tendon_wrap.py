"""Tendons around spheres and cylinders: MuJoCo's lengths and moments, and finite gradients where they begin to touch."""

import inspect

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics import rigid
from rewax.physics.rigid import forces as rigid_forces
from rewax.physics.rigid.mjx_access import mjx, tendon, tendon_jacobian
from rewax.xla_options import unoptimised

ARM = """<mujoco><compiler angle="radian"/><option timestep="0.005" gravity="0 0 0"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
  {geom}<site name="a" pos="-.2 {y} {height}"/><site name="side" pos=".01 0 -.2"/>
  <body><joint name="j" axis="0 1 0" damping=".01"/><geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".3"/>
    <body><joint name="k" axis="0 0 1"/><geom size=".02" mass=".1" pos=".2 0 0"/><site name="b" pos=".2 {y} {height}"/></body>
  </body></worldbody>
  <tendon><spatial name="t"><site site="a"/><geom geom="pulley" {side}/><site site="b"/></spatial></tendon>
  <actuator><motor tendon="t" gear="-1"/></actuator></mujoco>"""
CYLINDER = '<geom name="pulley" type="cylinder" size=".05 .02" euler="1.5707963267948966 0 0"/>'
SPHERE = '<geom name="pulley" type="sphere" size=".05"/>'
LOWER = '<geom name="lower" type="cylinder" size=".02 .02" pos=".1 0 .04" euler="1.5707963267948966 0 0"/><site name="between" pos=".06 0 .06"/>'
CASES = {
    "cylinder": {"geom": CYLINDER, "y": 0.03, "height": 0.07, "side": ""},
    "tangent": {"geom": CYLINDER, "y": 0, "height": 0.05, "side": ""},
    "sphere": {"geom": SPHERE, "y": 0.01, "height": 0.06, "side": ""},
    "two of them": {
        "geom": SPHERE + LOWER,
        "y": 0.01,
        "height": 0.06,
        "side": '/><site site="between"/><geom geom="lower"',
    },
    "sphere with a side": {"geom": SPHERE, "y": 0.01, "height": 0.02, "side": 'sidesite="side"'},
}
ANGLES = np.linspace(-1.2, 1.2, 400)


@pytest.mark.parametrize("name", CASES)
def test_lengths_and_moments_are_mujocos(x64, name):
    text = ARM.format(**CASES[name])
    mj, model = mujoco.MjModel.from_xml_string(text), rigid.load(text)
    data = mujoco.MjData(mj)

    def measured(angle):
        qpos = jnp.stack([angle, 0.3 * angle])
        kin = rigid_forces.kinematics(model, qpos)
        m, d = rigid_forces.mjx_data(model, kin, rigid.initial_state(model, qpos), jnp.zeros(1))
        d = tendon(m, d)
        return d.ten_length[0], tendon_jacobian(d)[0]

    lengths, moments = map(np.asarray, jax.jit(jax.vmap(measured), compiler_options=unoptimised())(ANGLES))
    wrapped = []
    for angle, length, moment in zip(ANGLES, lengths, moments, strict=True):
        data.qpos[:] = [angle, 0.3 * angle]
        mujoco.mj_forward(mj, data)
        wrapped.append(data.ten_wrapnum[0] > (3 if "two" in name else 2))  # more points than sites
        np.testing.assert_allclose(length, data.ten_length[0], atol=1e-10, err_msg=angle)
        np.testing.assert_allclose(moment, data.ten_J.reshape(-1)[:2], atol=1e-9, err_msg=angle)
    assert np.sum(wrapped) > 40


@pytest.mark.parametrize("name", ["cylinder", "tangent", "sphere"])
def test_gradients_are_finite_in_single_precision(name):
    """Also where the tendon begins to touch: those of MJX are NaN there, and its moments may have another sign."""
    text = ARM.format(**CASES[name])
    model = rigid.load(text)

    def velocity(qpos, ctrl):
        return rigid.step(model, rigid.initial_state(model, qpos), ctrl).qvel[0]

    angles = np.concatenate([np.linspace(-0.4, 0.4, 2001), [0.0, 1e-5, -1e-4, 1e-4, 1e-3]])
    points = jnp.asarray(np.stack([angles, 0.3 * angles], axis=1), jnp.float32)
    both = jax.value_and_grad(velocity, argnums=(0, 1))
    found, (by_angle, by_ctrl) = jax.jit(jax.vmap(both, (0, None)), compiler_options=unoptimised())(points, jnp.ones(1))
    assert np.isfinite(found).all() and np.isfinite(by_angle).all() and np.isfinite(by_ctrl).all()
    mj = mujoco.MjModel.from_xml_string(text)
    for k in (0, 700, 2001, 2002, 2003, 2005):
        data = mujoco.MjData(mj)
        data.qpos[:], data.ctrl[:] = points[k], 1.0
        mujoco.mj_step(mj, data)
        np.testing.assert_allclose(found[k], data.qvel[0], rtol=2e-4, atol=2e-5)
        np.testing.assert_allclose(by_ctrl[k, 0], found[k], rtol=1e-3)


def test_what_mjx_is_given_for_the_time_of_a_call_is_taken_back():
    support = inspect.unwrap(mjx.tendon).__globals__["support"]
    before = support.wrap
    with pytest.raises(Exception, match=r".+"):
        tendon(None, None)
    assert support.wrap is before and callable(mjx.tendon)
