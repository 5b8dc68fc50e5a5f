"""Kinematics and dynamics of trees: against MuJoCo's own, and what mechanics says about them."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rewax.physics.numerics.rotations import quaternion_to_matrix
from rewax.physics.rigid.kinematic_tree import JointType, TreeParameters, TreeTopology, tree_topology
from rewax.physics.rigid.kinematics import (
    body_velocities,
    generalized_forces,
    integrate,
    kinematics,
    point_velocities,
    wrenches_at,
)
from rewax.physics.rigid.small_products import rotate
from rewax.physics.rigid.tree_dynamics import inverse_dynamics, mass_matrix

ODD = """<mujoco><worldbody>
  <body pos="0 0 1" quat=".8 .6 0 0"><joint type="ball" pos=".1 0 .2"/><joint type="slide" axis="1 1 0" ref=".3"/>
    <geom type="box" size=".1 .2 .3" pos=".1 .2 0" euler="10 20 30"/>
    <body pos=".3 0 0"><geom size=".1"/>
      <body pos="0 .2 0" euler="30 0 20"><joint axis="0 1 0" pos="0 0 .1" armature=".3"/><joint axis="1 .3 0" pos="0 .2 .1"/>
        <geom type="capsule" size=".05 .2"/><body><geom size=".03" pos=".1 0 0"/></body></body></body></body>
  <body pos="0 -1 2"><geom size=".1"/></body>
  <body pos="3 0 1"><freejoint/><geom type="box" size=".1 .2 .3" pos=".1 .2 0" euler="10 20 30"/>
    <body pos=".1 .2 .3"><joint type="ball" pos=".1 0 0" armature=".05"/><geom size=".1"/></body></body>
</worldbody></mujoco>"""
"""All kinds of joints, several on one body, bodies without any between and below them, one fixed to the world."""

BODY = '<body pos="0 0 .3" euler="9 5 0"><joint axis="{}"/><geom size=".05" pos=".02 0 .1"/>{}</body>'
CHAIN = functools.reduce(lambda inner, i: BODY.format(("1 0 0", "0 1 0", "0 0 1")[i % 3], inner), range(9), "")
CHAIN = f"<mujoco><worldbody>{CHAIN}</worldbody></mujoco>"
TREES = {"odd": ODD, "chain": CHAIN}


@functools.cache
def compiled(name: str):
    mj = mujoco.MjModel.from_xml_string(TREES[name])
    mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    topology = tree_topology(mj.body_parentid, mj.jnt_bodyid, mj.jnt_type)

    @jax.jit
    def everything(parameters, gravity, q, v, a, dt):
        kin = kinematics(topology, parameters, q)
        return {
            "kinematics": kin,
            "velocities": body_velocities(topology, kin, v),
            "mass": mass_matrix(topology, parameters, kin),
            "force": inverse_dynamics(topology, parameters, kin, v, a, gravity),
            "bias": inverse_dynamics(topology, parameters, kin, v, 0.0 * a, gravity),
            "moved": integrate(topology, q, v, dt),
        }

    return mj, topology, everything


def parameters_of(mj) -> TreeParameters:
    return TreeParameters(**{name: jnp.asarray(getattr(mj, name)) for name in TreeParameters._fields})


def draw(mj, seed: int, scale: float = 1.0):
    """Positions with unit quaternions, velocities and accelerations."""
    rng = np.random.default_rng(seed)
    q = mj.qpos0 + scale * rng.standard_normal(mj.nq)
    mujoco.mj_normalizeQuat(mj, q)
    return q, 2.0 * rng.standard_normal(mj.nv), 3.0 * rng.standard_normal(mj.nv)


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


def test_velocities_are_rates_of_positions_and_forces_their_dual(x64):
    """d/dt of a point of a body; work of a force at that point = work of its generalized force."""
    mj, topology, _ = compiled("odd")
    q, v, _ = (jnp.asarray(x) for x in draw(mj, 5))
    parameters, rng = parameters_of(mj), np.random.default_rng(1)
    body, local, force = jnp.arange(mj.nbody), rng.standard_normal((mj.nbody, 3)), rng.standard_normal((mj.nbody, 3))

    @jax.jit
    def measure(q, v):
        def place(t):
            kin = kinematics(topology, parameters, integrate(topology, q, v, t))
            return kin.position + rotate(kin.rotation, jnp.asarray(local))

        point, rate = jax.jvp(place, (0.0,), (1.0,))
        kin = kinematics(topology, parameters, q)
        twist = body_velocities(topology, kin, v)
        wrenches = wrenches_at(kin, body, point, jnp.asarray(force), mj.nbody)
        return rate, point_velocities(kin, twist, body, point), generalized_forces(topology, kin, wrenches)

    rate, velocity, generalized = measure(q, v)
    np.testing.assert_allclose(velocity, rate, atol=1e-12)
    assert np.sum(force * velocity) == pytest.approx(float(generalized @ v), rel=1e-12)
    assert np.abs(velocity[1:]).min(axis=1).max() > 0.1


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


AXES = [np.array([0.6, -0.48, 0.64]), np.array([0.0, 0.0, 1.0])]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.9e-3, 2.1e-3, 0.3, 3.0, 9.0])
def test_turning_is_exact_at_every_angle_and_so_is_its_derivative(x64, angle):
    """Near 2e-3 a series begins to replace sine and cosine; at zero a naive derivative is 0 or NaN."""
    topology = tree_topology(np.array([0, 0]), np.array([1]), np.array([JointType.BALL]))
    start, dt = np.array([0.5, 0.5, -0.1, 0.7]), 0.02
    start /= np.linalg.norm(start)
    turn = jax.jit(lambda q, w: integrate(topology, q, w, dt))
    derivative = jax.jit(jax.jacfwd(lambda w: integrate(topology, jnp.asarray(start), w, dt)))
    for axis in AXES:
        rate = axis * angle / dt
        expected = np.zeros(4)
        mujoco.mju_mulQuat(expected, start, np.append(np.cos(angle / 2), np.sin(angle / 2) * axis))
        np.testing.assert_allclose(turn(start, rate), expected, atol=1e-15)
        assert np.linalg.norm(turn(3.0 * start, rate)) == pytest.approx(1.0, abs=1e-15)
        step = 1e-5
        moves = [(turn(start, rate + step * e) - turn(start, rate - step * e)) / (2 * step) for e in np.eye(3)]
        np.testing.assert_allclose(derivative(rate), np.stack(moves, axis=1), atol=1e-11)
        reverse = jax.jit(jax.jacrev(lambda w: integrate(topology, jnp.asarray(start), w, dt)))(rate)
        np.testing.assert_allclose(reverse, derivative(rate), atol=1e-15)
    if angle == 0.0:
        half = 0.5 * dt * np.stack([mul(start, np.append(0.0, e)) for e in np.eye(3)], axis=1)
        np.testing.assert_allclose(derivative(rate), half, atol=1e-15)


def mul(a, b):
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, a, b)
    return out


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


def test_the_rounds_of_a_chain_grow_with_the_logarithm_of_its_length():
    assert [len(chain_topology(n).ancestors) for n in (1, 2, 4, 8, 16, 32)] == [0, 1, 2, 3, 4, 5]


def chain_topology(num: int) -> TreeTopology:
    return tree_topology(np.arange(num + 1) - (np.arange(num + 1) > 0), np.arange(1, num + 1), np.full(num, 3))
