"""Rigid tasks with one compiled step each, and what several tests of them need."""

import copy
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import rewax
from rewax.envs.rigid_task import RigidPhysics
from rewax.physics import rigid
from rewax.viz.shapes import support

NUM_ENVS = 8


@functools.cache
def make(name, scale="small"):
    return rewax.make(name, scale=scale)


@functools.cache
def step(name):
    """One control step of ``NUM_ENVS`` environments."""
    return jax.jit(jax.vmap(make(name).step))


@functools.cache
def start(name):
    """First states of ``NUM_ENVS`` environments."""
    return jax.jit(jax.vmap(make(name).reset))(jax.random.split(jax.random.key(0), NUM_ENVS))


def starts(name, num=4096):
    """Positions and velocities of many first states, shapes (num, num_positions) and (num, num_dofs)."""
    bodies, _ = jax.vmap(make(name).start)(jax.random.split(jax.random.key(1), num))
    return np.asarray(bodies.qpos), np.asarray(bodies.qvel)


def assert_uniform(values, middle, bound):
    """Columns fill [middle - bound, middle + bound] evenly."""
    unit = (np.asarray(values, np.float64) - middle) / bound
    assert np.abs(unit).max() <= 1.0 + 1e-4
    assert np.abs(unit).max(axis=0).min() > 0.99
    np.testing.assert_allclose(unit.mean(axis=0), 0.0, atol=0.06)
    np.testing.assert_allclose((unit**2).mean(axis=0), 1.0 / 3.0, atol=0.04)


def random_physics(name, seed, num=6):
    """States anywhere, with an action each and a task of random numbers: as the task sees them, and as numpy does."""
    env, rng = make(name), np.random.default_rng(seed)
    q = rng.uniform(-1.0, 1.0, (num, env.model.num_positions))
    v = rng.uniform(-2.0, 2.0, (num, env.model.num_dofs))
    if env.model.num_positions > env.model.num_dofs:
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    action, task = rng.uniform(-1.0, 1.0, (2, num, env.model.num_actuators))
    bodies = jax.vmap(lambda q, v: rigid.initial_state(env.model, q, v))(jnp.float32(q), jnp.float32(v))
    return RigidPhysics(rigid=bodies, action=jnp.float32(action), task=jnp.float32(task)), q, v, action, task


def rotations(q):
    """Rotation matrices of free joints, shape (num, 3, 3)."""
    return Rotation.from_quat(q[:, [4, 5, 6, 3]]).as_matrix()


def observed(name, physics):
    obs = jax.vmap(make(name).observe)(physics)
    assert list(obs) == ["state"]
    return np.asarray(obs["state"])


def rewarded(name, physics):
    return np.asarray(jax.vmap(make(name).reward)(physics)[0])


def terminated(name, physics):
    return np.asarray(jax.vmap(make(name).terminated)(physics))


def joint_names(name):
    """Hinges and slides in the order of positions."""
    mj = make(name).model.static.mj
    return [mj.joint(i).name for i in range(mj.njnt) if mj.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]


def actuated(name):
    """Joints in the order of actions."""
    mj = make(name).model.static.mj
    return [mj.joint(mj.actuator_trnid[i, 0]).name for i in range(mj.nu)]


def ranges(name):
    """Limits of the actuated joints [rad], shape (num_actuators, 2)."""
    mj = make(name).model.static.mj
    return mj.jnt_range[mj.actuator_trnid[:, 0]]


def masses(name):
    """Mass of each body by name [kg], without the world's."""
    mj = make(name).model.static.mj
    return {mj.body(i).name: float(mj.body_mass[i]) for i in range(1, mj.nbody)}


def step_in_the_air(name, scale_of_action=0.3):
    """A control step of this library and of MuJoCo, far above the ground and within all limits, with random actions.

    Returns:
      Positions and velocities afterwards of either, and MuJoCo's without any action, shapes (num_envs, ...).
    """
    env, rng = make(name), np.random.default_rng(3)
    first = start(name)
    q, v = np.array(first.physics.rigid.qpos), np.array(first.physics.rigid.qvel)
    up = int(np.argmax(env.up))
    q[:, up if env.model.num_positions > env.model.num_dofs else 1] += 3.0
    middle = env.model.static.mj.qpos0[-env.model.num_actuators :].copy()
    low, high = ranges(name).T
    limited = high > low
    middle[limited] = 0.5 * (low + high)[limited]
    q[:, -env.model.num_actuators :] = middle
    action = rng.uniform(-scale_of_action, scale_of_action, (NUM_ENVS, env.model.num_actuators)).astype(np.float32)
    bodies = first.physics.rigid.replace(qpos=jnp.asarray(q), qvel=jnp.asarray(v))
    after = step(name)(first.replace(physics=first.physics.replace(rigid=bodies)), action).physics.rigid
    c = [_mujoco_step(env, q[i], v[i], np.asarray(env.control(jnp.asarray(action[i])))) for i in range(NUM_ENVS)]
    rest = [_mujoco_step(env, q[i], v[i], np.asarray(env.control(jnp.zeros_like(action[i])))) for i in range(NUM_ENVS)]
    ours = np.concatenate([after.qpos, after.qvel], axis=1)
    return ours, np.stack(c), np.stack(rest)


def _mujoco_step(env, q, v, ctrl):
    model = copy.copy(env.model.static.mj)
    model.dof_armature[:] = np.asarray(env.model.parameters["dof_armature"])
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, ctrl
    mujoco.mj_step(model, data, nstep=env.num_substeps)
    return np.concatenate([data.qpos, data.qvel])


def drop(name, max_steps=600):
    """Final states without action, once nothing moves faster than 0.1 m/s or rad/s."""
    env, state = make(name), start(name)
    nothing = jnp.zeros((NUM_ENVS, env.model.num_actuators))
    for count in range(max_steps):
        state = step(name)(state, nothing)
        if count % 20 == 19 and float(jnp.abs(state.physics.rigid.qvel).max()) < 0.1:
            break
    return state


def lowest(name, state, number):
    """Height of the lowest point of the bodies of one environment [m]."""
    env = make(name)
    shapes = env.render_shapes(jax.tree.map(lambda leaf: leaf[number], state.physics))
    solid = [shape for shape in shapes if shape["kind"] != "plane"]
    return min(float(support(shape, -env.up) @ env.up) for shape in solid)


def gradient(name, num_starts=64, num_steps=3):
    """Of the rewards of a few steps with respect to their actions, from many starts, shape (num_starts, steps, n)."""
    env = make(name)

    def total(actions, key):
        def body(state, action):
            state = env.step(state, action)
            return state, state.reward

        return jnp.sum(jax.lax.scan(body, env.reset(key), actions)[1])

    keys = jax.random.split(jax.random.key(4), num_starts)
    shape = (num_starts, num_steps, env.model.num_actuators)
    actions = jax.random.uniform(jax.random.key(5), shape, minval=-0.9, maxval=0.9)
    return np.asarray(jax.jit(jax.vmap(jax.grad(total)))(actions, keys))
