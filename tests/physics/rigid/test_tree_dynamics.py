"""Inertia and inverse dynamics of trees: energy, power, invariance under turns, rounding, derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trees import compiled, draw, parameters_of

from rewax.physics.numerics.rotations import quaternion_to_matrix
from rewax.physics.rigid import mjcf
from rewax.physics.rigid.kinematic_tree import tree_topology
from rewax.physics.rigid.kinematics import (
    integrate,
    kinematics,
)
from rewax.physics.rigid.tree_dynamics import inverse_dynamics, mass_matrix, spin_slopes


@given(seed=st.integers(0, 10**6))
def test_mass_matrix_is_that_of_inverse_dynamics_and_of_kinetic_energy(x64, seed):
    mj, _, everything = compiled("odd")
    q, v, a = draw(mj, seed)
    got = everything(parameters_of(mj), mj.opt.gravity, q, v, a, 0.1)
    mass = np.asarray(got["mass"])
    np.testing.assert_array_equal(mass, mass.T)
    assert np.linalg.eigvalsh(mass).min() > 0
    np.testing.assert_allclose(got["force"] - got["bias"], mass @ a, atol=1e-11)
    kin, twist = got["kinematics"], np.asarray(got["velocities"])
    turn, at_com = twist[:, :3], twist[:, 3:] + np.cross(twist[:, :3], kin.com - kin.tree_com)
    local = np.einsum("bji,bj->bi", kin.inertia_rotation, turn)
    energy = np.sum(mj.body_mass[:, None] * at_com**2) + np.sum(mj.body_inertia * local**2)
    assert v @ mass @ v == pytest.approx(energy + mj.dof_armature @ v**2, rel=1e-12)


def test_powers_balance(x64):
    """Without gravity the forces' power is the rate of the kinetic energy: velocity products do no work."""
    mj, topology, everything = compiled("odd")
    q, v, a = draw(mj, 3)
    step, none = 1e-5, np.zeros(3)

    def kinetic(t):
        """Along the motion q(t) with q' = v + a t, to second order."""
        moved = np.asarray(integrate(topology, jnp.asarray(q), jnp.asarray(v + 0.5 * a * t), t))
        mass = np.asarray(everything(parameters_of(mj), none, moved, v, a, 0.0)["mass"])
        return 0.5 * (v + a * t) @ mass @ (v + a * t)

    power = v @ np.asarray(everything(parameters_of(mj), none, q, v, a, 0.0)["force"])
    assert power == pytest.approx((kinetic(step) - kinetic(-step)) / (2 * step), rel=1e-6)


def test_a_turned_world_changes_nothing_inside(x64):
    """Turned about the origin together with gravity: joint forces, mass matrix and body-frame forces stay."""
    mj, _, everything = compiled("odd")
    q, v, a = draw(mj, 7)
    first = int(np.flatnonzero(mj.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0])
    at, dof = mj.jnt_qposadr[first], mj.jnt_dofadr[first]
    turn = np.array([0.5, 0.1, -0.7, 0.5])
    turn /= np.linalg.norm(turn)
    R = np.asarray(quaternion_to_matrix(jnp.asarray(turn)))
    q2, v2, a2 = q.copy(), v.copy(), a.copy()
    q2[at : at + 3] = R @ q[at : at + 3]
    mujoco.mju_mulQuat(q2[at + 3 : at + 7], turn, q[at + 3 : at + 7])
    for x, turned in ((v, v2), (a, a2)):
        turned[dof : dof + 3] = R @ x[dof : dof + 3]
    here = np.asarray(everything(parameters_of(mj), mj.opt.gravity, q, v, a, 0.1)["force"])[dof:]
    there = np.asarray(everything(parameters_of(mj), R @ mj.opt.gravity, q2, v2, a2, 0.1)["force"])[dof:]
    np.testing.assert_allclose(there[3:], here[3:], atol=1e-11)
    np.testing.assert_allclose(there[:3], R @ here[:3], atol=1e-11)


def test_rounding_does_not_grow_far_from_the_origin():
    """In float32, 300 m away: the mass matrix keeps six digits of the body's own size, where x^2 would lose all."""
    mj, topology, _ = compiled("odd")
    parameters = jax.tree.map(lambda x: x.astype(jnp.float32), parameters_of(mj))
    q = draw(mj, 2)[0].astype(np.float32)
    at = int(mj.jnt_qposadr[np.flatnonzero(mj.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0]])
    far = q.copy()
    far[at : at + 3] += np.float32([256.0, -256.0, 128.0])
    mass = jax.jit(lambda q: mass_matrix(topology, parameters, kinematics(topology, parameters, q)))
    near, away = (np.asarray(mass(x)) for x in (q, far))
    assert near.dtype == np.float32
    np.testing.assert_allclose(away, near, atol=3e-4 * np.abs(near).max())


def test_derivatives_with_respect_to_every_parameter(x64, random_like, central_difference, derivatives, inner):
    """Of positions and of inverse dynamics: reverse = forward = finite difference, leaf by leaf."""
    mj, topology, _ = compiled("odd")
    q, v, a = draw(mj, 11)
    arguments = (parameters_of(mj), *(jnp.asarray(x) for x in (q, v, a, mj.opt.gravity)))

    def measure(arguments):
        parameters, q, v, a, gravity = arguments
        kin = kinematics(topology, parameters, q)
        return kin.position, kin.rotation, inverse_dynamics(topology, parameters, kin, v, a, gravity)

    program = derivatives(measure)

    def weights(out):
        return random_like(0, out)

    zero = jax.tree.map(jnp.zeros_like, arguments)
    _, _, cotangent, gradient = program(arguments, zero, weights=weights)
    leaves, treedef = jax.tree.flatten(arguments)
    noise = jax.tree.leaves(random_like(1, arguments))
    for i in range(len(leaves)):
        move = treedef.unflatten([noise[i] if i == j else jnp.zeros_like(x) for j, x in enumerate(leaves)])
        forward = inner(program(arguments, move, weights=weights)[1], cotangent)
        difference = inner(
            central_difference(lambda x: program(x, zero, weights=weights)[0], arguments, move), cotangent
        )
        assert forward == pytest.approx(inner(gradient, move), rel=1e-10)
        assert forward == pytest.approx(difference, rel=1e-6)
        assert forward != 0.0


LONE = """<mujoco><worldbody><body><freejoint/><geom type="box" size=".1 .2 .05" pos=".1 0 .05"/>
  <body pos=".3 .2 0"><geom size=".1"/></body></body>
  <body pos="2 0 0"><freejoint/><geom size=".1"/><body pos=".3 0 0"><joint axis="0 1 0"/><geom size=".1"/></body></body>
  </worldbody></mujoco>"""


def test_slopes_of_spin_are_the_derivative_of_the_bias(x64):
    """Of the body that flies alone, one that is fixed to it included; of the one with a joint nothing."""
    mj = mujoco.MjModel.from_xml_string(LONE)
    alone = mjcf.lone_dofs(mj)
    np.testing.assert_array_equal(alone, [np.arange(6)])
    topology = tree_topology(mj.body_parentid, mj.jnt_bodyid, mj.jnt_type)
    qvel = jnp.asarray(np.random.default_rng(0).standard_normal(mj.nv))
    parameters = parameters_of(mj)

    @jax.jit
    def both(qvel):
        kin = kinematics(topology, parameters, jnp.asarray(mj.qpos0))
        still, weightless = jnp.zeros(mj.nv), jnp.zeros(3)
        bias = jax.jacfwd(lambda v: inverse_dynamics(topology, parameters, kin, v, still, weightless))(qvel)
        return bias, spin_slopes(topology, parameters, kin, qvel, alone)

    expected, found = (np.asarray(a) for a in both(qvel))
    np.testing.assert_allclose(found[:6, :6], expected[:6, :6], atol=1e-12)
    assert not found[6:].any() and not found[:, 6:].any() and np.abs(expected[:6, 3:6]).max() > 1.0
