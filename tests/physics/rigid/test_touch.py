"""Contacts as rigid bodies feel them: MuJoCo's forces, weights, both laws, derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models

from rewax.physics import rigid
from rewax.physics.contact import Patches
from rewax.physics.rigid import Penalty

STEP = jax.jit(rigid.step_with_touch, static_argnames="num_substeps")
RUBBING = """<mujoco><option timestep="0.002" cone="pyramidal"/><worldbody>
  <geom name="floor" type="plane" size="9 9 1" condim="{dim}" friction="0.8 0.02 0.01"/>
  <body name="ball" pos="0 0 .0985"><freejoint/><geom size=".1" density="300" condim="{dim}" friction="0.8 0.02 0.01"/></body>
  <body name="other" pos=".178 0 .0793"><freejoint/><geom size=".08" density="300" condim="{dim}"/></body>
</worldbody></mujoco>"""


def loaded(dim, penalty=None):
    return rigid.load(RUBBING.format(dim=dim), dt=0.002, penalty=penalty)


def moving(model):
    qvel = jnp.array([0.6, 0.3, -0.2, 0.5, 1.0, 2.0, -0.1, 0.2, 0.0, 0.0, 0.1, 0.3])
    return rigid.initial_state(model, qvel=qvel)


def forces_in_c(model, state):
    """Force and torque of MuJoCo's contacts on each body about its frame's origin, world axes, (num_bodies, 3)."""
    mj = mujoco.MjModel.from_xml_string(RUBBING.format(dim=model.static.mj.geom_condim[0]))
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    mujoco.mj_forward(mj, data)
    force, torque = np.zeros((2, mj.nbody, 3))
    for k in range(data.ncon):
        contact, local = data.contact[k], np.zeros(6)
        mujoco.mj_contactForce(mj, data, k, local)
        turn = contact.frame.reshape(3, 3).T
        for geom, sign in zip(contact.geom, (-1.0, 1.0), strict=True):
            body = mj.geom_bodyid[geom]
            f = sign * turn @ local[:3]
            force[body] += f
            torque[body] += sign * turn @ local[3:] + np.cross(contact.pos - data.xpos[body], f)
    return force, torque


@pytest.mark.parametrize("dim", [1, 3, 6])
def test_forces_are_those_of_mujoco(x64, dim):
    model = loaded(dim)
    state = moving(model)
    _, felt = STEP(model, state, patches=Patches(body=(0, 1, 2)))
    force, torque = forces_in_c(model, state)
    assert np.abs(force[1]).max() > 1.0 and np.abs(force[2]).max() > 1.0
    np.testing.assert_allclose(felt.force, force, atol=2e-3 * np.abs(force).max())
    np.testing.assert_allclose(felt.torque, torque, atol=2e-3 * np.abs(torque).max())


@pytest.mark.parametrize("penalty", [None, Penalty(stiffness=2e4, damping=40.0, friction_damping=10.0)])
def test_forces_change_the_momentum(x64, penalty):
    model = loaded(3, penalty)
    state, num = moving(model), 5
    end, felt = STEP(model, state.replace(unsolved=1.0), patches=Patches(body=(1, 2, 0)), num_substeps=num)
    assert float(end.unsolved) == 0.0
    expected = rigid.step(model, state, num_substeps=num)
    np.testing.assert_allclose(end.qvel, expected.qvel, atol=1e-12)
    mass = np.asarray(model.parameters["body_mass"])
    for row, (body, dof) in enumerate(((1, 0), (2, 6))):
        change = mass[body] * (end.qvel - state.qvel)[dof : dof + 3] / (num * 0.002)
        np.testing.assert_allclose(felt.force[row], change - mass[body] * model.gravity, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(felt.force.sum(0), 0.0, atol=1e-9)


@pytest.mark.parametrize("penalty", [None, Penalty(stiffness=2e4, damping=40.0, friction_damping=10.0, onset=1e-3)])
def test_the_derivative_of_forces_is_exact(x64, penalty, random_like, derivatives_agree):
    model = loaded(3, penalty)
    patches = Patches(body=(1, 1, 2), center=[[0, 0, -0.1], [0.1, 0, 0], [0, 0, 0]])

    def felt(given):
        state, wrenches = given
        return rigid.step_with_touch(model, state, wrenches=wrenches, patches=patches, num_substeps=2)[1]

    at = (moving(model), jnp.zeros((3, 6)))
    dx = random_like(0, at)
    dx = jax.tree.map(lambda a: 1e-4 * a, (dx[0].replace(qacc=jnp.zeros_like(dx[0].qacc)), dx[1]))
    derivatives_agree(felt, at, dx, step=1e-3, bar=1e-5, exact=1e-7)


def test_what_cannot_touch_feels_nothing():
    model = rigid.load(rigid_models.pendulum())
    _, felt = STEP(model, rigid.initial_state(model), patches=Patches(body=(1,)))
    assert not np.any(felt.force) and not np.any(felt.torque)
