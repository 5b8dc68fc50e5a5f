"""Articulated rigid bodies: C MuJoCo's trajectories, conserved quantities, one program per model, clear errors."""

import functools
import importlib.metadata
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_models
from mujoco import mjx

from rewax.physics import rigid
from rewax.physics.rigid_penalty import Penalty
from rewax.status import Status

STEPS, CALLS = 20, 5


@functools.cache
def loaded(name: str):
    """MuJoCo's model and ours."""
    text = getattr(rigid_models, name)()
    return mujoco.MjModel.from_xml_string(text), rigid.load(text)


@jax.jit
def advance(model, state, ctrl, wrenches):
    return rigid.step(model, state, ctrl, wrenches=wrenches, num_substeps=STEPS)


def simulate_in_c(mj, qpos, qvel, ctrl=0.0, wrenches=0.0, steps: int = STEPS * CALLS, act=0.0):
    """MuJoCo's data after some steps, and its number of contacts before each."""
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:], data.ctrl[:], data.xfrc_applied[:] = qpos, qvel, ctrl, wrenches
    data.act[:] = act
    contacts = []
    for _ in range(steps):
        mujoco.mj_step(mj, data)
        contacts.append(data.ncon)
    return data, contacts


def names(mj, kind: str) -> set[str]:
    count = {"joint": mj.njnt, "body": mj.nbody}[kind]
    return {getattr(mj, kind)(i).name for i in range(count)}


def home(mj, **shifts: float) -> np.ndarray:
    """MuJoCo's positions of the model's home, some joints (or free bodies' heights) shifted."""
    qpos = mj.key_qpos[0].copy() if mj.nkey else mj.qpos0.copy()
    for joint, shift in shifts.items():
        number = mj.joint(joint).id if joint in names(mj, "joint") else mj.body(joint).jntadr[0]
        free = mj.jnt_type[number] == mujoco.mjtJoint.mjJNT_FREE
        qpos[mj.jnt_qposadr[number] + 2 * free] += shift
    return qpos


def draw(mj, speed: float = 0.3, push: float = 0.2, seed: int = 0):
    """Velocities, controls and wrenches."""
    rng = np.random.default_rng(seed)
    wrenches = push * rng.standard_normal((mj.nbody, 6))
    wrenches[0] = 0.0
    return speed * rng.standard_normal(mj.nv), rng.uniform(-1, 1, mj.nu), wrenches


# --- Agreement with C MuJoCo ------------------------------------------------------------------------------------------

FAR, NEAR = "smooth", "touching"
CASES = [
    ("pendulum", FAR, {"turn0": 1.0, "turn1": 2.0}, {}),
    ("ball", FAR, {"ball": 2.0}, {}),
    ("ball", NEAR, {"ball": -0.15}, {"speed": 2.0}),
    ("hopper", FAR, {"z": 1.0}, {}),
    ("hopper", NEAR, {"z": -0.01}, {}),
    ("ant", FAR, {"trunk": 2.0}, {}),
    ("ant", NEAR, {"trunk": -0.05}, {}),
    ("hand", FAR, {"cube": 1.0}, {"push": 0.001}),
    ("hand", NEAR, dict.fromkeys(("j01", "j11", "j21", "j31"), 0.3), {"push": 0.001}),
    ("contraption", NEAR, {}, {"speed": 1.0}),
]


@pytest.mark.parametrize(("name", "kind", "shifts", "scales"), CASES, ids=[f"{name}-{kind}" for name, kind, *_ in CASES])
def test_a_hundred_steps_agree_with_mujoco(x64, name, kind, shifts, scales):
    """Positions, velocities, activations and the last accelerations, with controls and wrenches on every body.

    The contraption has the rest: damping, dry friction, connect and joint equalities, tendons, servos, activations, a
    medium. The cube of the hand is touched by balls only: of a box on a plane MJX drops the corners that are a
    millimetre shallower than the deepest, so no agreement can be expected there.
    """
    mj, model = loaded(name)
    qpos, (qvel, ctrl, wrenches) = home(mj, **shifts), draw(mj, **scales)
    data, contacts = simulate_in_c(mj, qpos, qvel, ctrl, wrenches)
    assert (max(contacts) > 0) == (kind == NEAR)
    state = rigid.initial_state(model, qpos, qvel)
    for _ in range(CALLS):
        state = advance(model, state, ctrl, wrenches)
    print(name, kind, np.abs(state.qpos - data.qpos).max(), np.abs(state.qvel - data.qvel).max(), max(contacts))
    np.testing.assert_allclose(state.qpos, data.qpos, atol=1e-8)
    np.testing.assert_allclose(state.qvel, data.qvel, atol=1e-7)
    np.testing.assert_allclose(state.act, data.act, atol=1e-8)
    np.testing.assert_allclose(state.qacc, data.qacc, atol=1e-5, rtol=1e-7)
    assert np.abs(data.qpos - qpos).max() > 0.01


def test_the_contraption_has_all_kinds_of_rows():
    """Of equalities, of dry friction of joints and tendons, of their limits, with friction in contact and without."""
    mj, _ = loaded("contraption")
    kinds = mujoco.mjtConstraint
    data = simulate_in_c(mj, home(mj), np.zeros(mj.nv), steps=1)[0]
    limited = ("FRICTION_DOF", "FRICTION_TENDON", "LIMIT_JOINT", "LIMIT_TENDON", "CONTACT_FRICTIONLESS", "CONTACT_PYRAMIDAL")
    assert {"EQUALITY", *limited} == {kinds(k).name.removeprefix("mjCNSTR_") for k in data.efc_type}


ADDED = {"qpos0", "qpos_spring", "body_pos", "body_quat", "body_ipos", "body_iquat", "jnt_pos", "jnt_axis", "geom_pos", "geom_quat"}


def changed(mj, name: str) -> np.ndarray:
    """Other numbers for a parameter: all factors a few per cent different, places a centimetre, turns a degree."""
    value, rng = np.array(getattr(mj, name)), np.random.default_rng(len(name))
    new = value + 0.02 * rng.standard_normal(value.shape) if name in ADDED else value * rng.uniform(1.02, 1.1, value.shape)
    if name.endswith(("quat", "axis")):
        new /= np.linalg.norm(new, axis=1, keepdims=True)
    free = mj.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    if name == "jnt_pos":
        new[free] = value[free]  # a free joint has none
    return new


@functools.cache
def plain_contraption():
    """In which C MuJoCo makes no use of what it knew about the numbers when it read the model."""
    mj, model = loaded("contraption")
    mj = mujoco.MjModel.from_xml_string(rigid_models.contraption())
    for field in ("body_sameframe", "geom_sameframe", "site_sameframe"):
        getattr(mj, field)[:] = 0
    assert not mj.body_simple[1:].any()
    mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    mj.geom_rbound[2:] *= 1.5
    return mj, model


@pytest.mark.parametrize("name", rigid.PARAMETERS)
def test_other_parameters_do_what_they_do_in_mujoco(x64, name):
    """Each of them is heeded, at the first step already, and none needs another program."""
    mj, model = plain_contraption()
    qpos, (qvel, ctrl, wrenches) = home(mj), draw(mj, speed=1.0)
    before, value = simulate_in_c(mj, qpos, qvel, ctrl, wrenches, STEPS)[0], np.array(getattr(mj, name))
    new = changed(mj, name)
    try:
        getattr(mj, name)[:] = new
        after = simulate_in_c(mj, qpos, qvel, ctrl, wrenches, STEPS)[0]
    finally:
        getattr(mj, name)[:] = value
    with jax.log_compiles():
        state = advance(model.with_parameters(**{name: new}), rigid.initial_state(model, qpos, qvel), ctrl, wrenches)
    print(name, np.abs(state.qpos - after.qpos).max(), np.abs(after.qpos - before.qpos).max())
    np.testing.assert_allclose(state.qpos, after.qpos, atol=1e-7)  # as well as MuJoCo's solver converges
    assert np.abs(after.qpos - before.qpos).max() > 1e-7
