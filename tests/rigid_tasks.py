"""Rigid tasks with one compiled step each, and what several tests of them need."""

import copy
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import rewax
from rewax.envs.kit.rigid_task import RigidPhysics
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
    bodies, _ = jax.jit(jax.vmap(make(name).start))(jax.random.split(jax.random.key(1), num))
    return np.asarray(bodies.qpos), np.asarray(bodies.qvel)


def assert_uniform(values, middle, bound):
    """Columns fill [middle - bound, middle + bound] evenly."""
    unit = (np.asarray(values, np.float64) - middle) / bound
    assert np.abs(unit).max() <= 1.0 + 1e-4
    assert np.abs(unit).max(axis=0).min() > 0.99
    np.testing.assert_allclose(unit.mean(axis=0), 0.0, atol=0.06)
    np.testing.assert_allclose((unit**2).mean(axis=0), 1.0 / 3.0, atol=0.04)


def random_physics(name, seed, num=6, columns=None):
    """States anywhere, with an action each and a task of random numbers: as the task sees them, and as numpy does.

    Args:
      name: of the environment.
      seed: of the numbers.
      num: of states.
      columns: positions that are given, by their number.
    """
    env, rng = make(name), np.random.default_rng(seed)
    q = rng.uniform(-1.0, 1.0, (num, env.model.num_positions))
    v = rng.uniform(-2.0, 2.0, (num, env.model.num_dofs))
    for column, values in (columns or {}).items():
        q[:, column] = values
    if env.model.num_positions > env.model.num_dofs:
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    action, task = rng.uniform(-1.0, 1.0, (2, num, env.model.num_actuators))
    bodies = jax.vmap(lambda q, v: rigid.initial_state(env.model, q, v))(jnp.float32(q), jnp.float32(v))
    return RigidPhysics(rigid=bodies, action=jnp.float32(action), task=jnp.float32(task)), q, v, action, task


def rotations(q):
    """Rotation matrices of free joints, shape (num, 3, 3)."""
    return Rotation.from_quat(q[:, [4, 5, 6, 3]]).as_matrix()


def observed(name, physics):
    obs = jax.jit(jax.vmap(make(name).observe))(physics)
    assert list(obs) == ["state"]
    return np.asarray(obs["state"])


def rewarded(name, physics):
    return np.asarray(jax.jit(jax.vmap(make(name).reward))(physics)[0])


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


def step_in_the_air(name, columns=None):
    """A control step of this library and of MuJoCo, above the ground and within all limits, with random actions.

    Args:
      name: of the environment.
      columns: positions that are given, by their number.

    Returns:
      Positions and velocities afterwards of either, and MuJoCo's without any action, shapes (NUM_ENVS, ...).
    """
    env, first = make(name), start(name)
    mj, bodies = env.model.static.mj, first.physics.rigid
    q = np.array(bodies.qpos)
    if mj.ngeom and mj.geom_type[0] == mujoco.mjtGeom.mjGEOM_PLANE:
        free = mj.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
        q[:, int(np.argmax(env.up)) if free else joint_names(name).index("root_z")] += 3.0
    q[:, mj.jnt_qposadr[mj.actuator_trnid[:, 0]]] = ranges(name).mean(axis=1)
    for column, values in (columns or {}).items():
        q[:, column] = values
    size = (NUM_ENVS, env.model.num_actuators)
    action = np.random.default_rng(3).uniform(-0.3, 0.3, size).astype(np.float32)
    lifted = first.replace(physics=first.physics.replace(rigid=bodies.replace(qpos=jnp.asarray(q))))
    after = step(name)(lifted, action).physics.rigid
    theirs, rest = (
        np.stack(
            [
                _mujoco_step(env, q[i], bodies.qvel[i], np.asarray(env.control(jnp.asarray(a[i]))))
                for i in range(NUM_ENVS)
            ]
        )
        for a in (action, np.zeros_like(action))
    )
    return np.concatenate([after.qpos, after.qvel], axis=1), theirs, rest


def _mujoco_step(env, q, v, ctrl):
    model = copy.copy(env.model.static.mj)
    for name in ("dof_armature", "body_inertia"):
        getattr(model, name)[:] = np.asarray(env.model.parameters[name])
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, ctrl
    mujoco.mj_step(model, data, nstep=env.num_substeps)
    return np.concatenate([data.qpos, data.qvel])


def capsule(radius, half_length):
    """Mass of a capsule of density 1000 [kg]."""
    return 1000.0 * np.pi * radius**2 * (2.0 * half_length + 4.0 / 3.0 * radius)


def resting_depths(name, *, num=2, max_steps=800):
    """How deep bodies sink into the ground once they rest [m]: of ``num`` environments, after steps without action.

    They rest below 0.1 m/s and rad/s; two of the eight may still creep or slip (friction holds like a damper).
    """
    env, state = make(name), start(name)
    nothing = jnp.zeros((NUM_ENVS, env.model.num_actuators))
    for count in range(1, max_steps + 1):
        state = step(name)(state, nothing)
        if count % 20 == 0:
            resting = np.flatnonzero(np.abs(state.physics.rigid.qvel).max(axis=1) < 0.1)
            if len(resting) >= NUM_ENVS - 2:
                return [-_lowest(env, jax.tree.map(lambda leaf: leaf[i], state.physics)) for i in resting[:num]]
    raise AssertionError(f"after {max_steps} steps without action only {len(resting)} of {NUM_ENVS} rest")


def _lowest(env, physics):
    """Height of the lowest point of all bodies [m]."""
    solid = [shape for shape in env.render_shapes(physics) if shape["kind"] != "plane"]
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
