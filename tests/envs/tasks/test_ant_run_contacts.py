"""AntRun beside its law written out in numpy: accelerations in contact, with the ground and of links with each other."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import rigid_tasks as tasks

import rewax
from rewax.physics import rigid

NUM = 48
GROUND, LINKS = (52e3, 1e3, 650.0, 0.625), (4e3, 1e3, 300.0, 0.75)
"""Stiffness, damping, friction's damping, coefficient."""


def test_links_touch_all_but_their_neighbours():
    """44 pairs: as in the reference all geoms of two bodies of which neither is the other's parent."""
    mj = tasks.make("AntRun").model.static.mj
    body, parent = mj.geom_bodyid, mj.body_parentid
    expected = {
        frozenset((a, b))
        for a in range(1, mj.ngeom)
        for b in range(1, a)
        if body[a] != body[b] and parent[body[a]] != body[b] and parent[body[b]] != body[a]
    }
    pairs = [frozenset((int(a), int(b))) for a, b in zip(mj.pair_geom1, mj.pair_geom2, strict=True)]
    among = [pair for pair in pairs if mj.geom("ground").id not in pair]
    assert len(pairs) == 13 + 44 and set(among) == expected and len(among) == len(expected)
    friction = tasks.make("AntRun").model.parameters["pair_friction"][:, 0]
    np.testing.assert_allclose(friction, [0.75 if pair in among else 0.625 for pair in pairs])


def test_the_suites_ant_touches_the_ground_only():
    mj = tasks.make("Ant").model.static.mj
    assert mj.npair == 13 and set(mj.pair_geom1) == {mj.geom("ground").id}


def test_armature_is_in_the_links_moments_of_inertia_too():
    """0.005 kg m^2 about all axes of the eight links, not of the torso."""
    model = tasks.make("AntRun").model
    added = np.asarray(model.parameters["body_inertia"]) - model.static.mj.body_inertia
    expected = np.zeros((10, 3))
    expected[2:] = 0.005
    np.testing.assert_allclose(added, expected, atol=1e-7)
    assert [model.static.mj.body(i).name for i in (0, 1, 2, 9)] == ["world", "torso", "hip_1", "ankle_4"]


@functools.cache
def states():
    """On the ground, or with legs that cross far beyond their limits: positions, velocities, controls, accelerations."""
    mj, rng = armed(), np.random.default_rng(0)
    data, found = mujoco.MjData(mj), []
    while len(found) < NUM:
        turn = np.array([0.707, -0.707, 0, 0]) + 0.2 * rng.standard_normal(4)
        q = np.concatenate([rng.standard_normal(3), turn / np.linalg.norm(turn), rng.uniform(-2.0, 2.0, 8)])
        lifted = len(found) % 2 == 0
        q[1] = 3.0 if lifted else rng.uniform(0.3, 0.6)
        v, ctrl = rng.standard_normal(mj.nv), rng.uniform(-1.0, 1.0, mj.nu)
        contacts, acceleration = by_hand(mj, data, q, v, ctrl)
        # Where two axes almost cross, at 16 cm, the normal is a matter of rounding.
        shallow = all(contact.dist > -0.12 for contact in data.contact)
        if shallow and contacts and (lifted or any(0 in geoms for geoms in contacts)):
            found.append((q, v, ctrl, acceleration))
    return tuple(map(np.array, zip(*found, strict=True)))


def armed():
    """MuJoCo's model with the links' moments of inertia as the reference has them."""
    mj = mujoco.MjModel.from_xml_path(str(rewax.envs.kit.rigid_task.ASSETS / "ant_run.xml"))
    mj.body_inertia[2:] += 0.005
    return mj


def by_hand(mj, data, q, v, ctrl):
    """Geoms of each contact; accelerations by the law, each body pushed at the deepest point of its own shape."""
    data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, ctrl
    mujoco.mj_forward(mj, data)
    mass, force = np.zeros((mj.nv, mj.nv)), -data.qfrc_bias + data.qfrc_actuator
    mujoco.mj_fullM(mj, data, mass)
    for contact in data.contact:
        stiffness, damping, rubbing, friction = GROUND if 0 in contact.geom else LINKS
        normal, jacobians = contact.frame[:3], []
        for side, geom in zip((-0.5, 0.5), contact.geom, strict=True):
            jacobian = np.zeros((3, mj.nv))
            point = contact.pos + side * contact.dist * normal
            mujoco.mj_jac(mj, data, jacobian, None, point, mj.geom_bodyid[geom])
            jacobians.append(jacobian)
        jacobian = jacobians[1] - jacobians[0]
        sliding = jacobian @ v
        speed = normal @ sliding
        push = -stiffness * contact.dist - damping * min(speed, 0.0)
        along = sliding - speed * normal
        drag = min(rubbing * np.linalg.norm(along), friction * push) / np.linalg.norm(along)
        force = force + jacobian.T @ (push * normal - drag * along)
    low, high = mj.jnt_range[1:].T
    beyond = np.minimum(q[7:] - low, 0.0) + np.maximum(q[7:] - high, 0.0)
    force[6:] -= np.where(beyond != 0, 1e3 * beyond + 10.0 * v[6:], 0.0)
    return [set(map(int, contact.geom)) for contact in data.contact], np.linalg.solve(mass, force)


def test_accelerations_in_contact_are_the_laws(x64):
    """To 1e-4: with contacts at half depth, or links without armature or without each other, they are off by more."""
    q, v, ctrl, expected = states()
    model = rewax.make("AntRun", scale="paper").model

    @jax.jit
    @jax.vmap
    def accelerations(q, v, ctrl):
        return (rigid.step(model, rigid.initial_state(model, q, v), ctrl).qvel - v) / model.dt

    found = np.asarray(accelerations(*map(jnp.asarray, (q, v, ctrl))))
    error = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)
    print(np.sort(error))
    assert error.max() < 1e-4 and np.median(error) < 1e-6
