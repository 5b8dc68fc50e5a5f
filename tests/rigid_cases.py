"""Models of ``rigid_models``, loaded by MuJoCo and by rewax, and what tests of rigid bodies do with both."""

import functools
import importlib.metadata

import jax
import mujoco
import numpy as np
import rigid_models

from rewax.physics import rigid
from rewax.xla_options import unoptimised

STEPS, CALLS = 20, 5
VERSIONS = (
    f"mujoco {mujoco.__version__} with mujoco-mjx {importlib.metadata.version('mujoco-mjx')} is not what rewax was written "
    "for (rewax/physics/rigid/model.py, forces.py):"
)


@functools.cache
def loaded(name: str):
    """MuJoCo's model and ours, in double precision."""
    text = getattr(rigid_models, name)()
    with jax.enable_x64(True):
        return mujoco.MjModel.from_xml_string(text), rigid.load(text)


@functools.partial(jax.jit, compiler_options=unoptimised())
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


ARM_ON_THE_FLOOR = rigid_models.mjcf(
    rigid_models.FLOOR
    + """<body pos="0 0 .3"><joint name="a" axis="0 1 0" range="0.1 2" frictionloss=".2"/><geom size=".05" fromto="0 0 0 .3 0 0" type="capsule"/>
      <body name="fore" pos=".3 0 0"><joint name="b" axis="0 1 .2"/><geom name="tip" size=".06" pos=".2 0 -.25"/>
      <body name="last" pos=".1 0 0"><joint name="c" axis="1 0 0"/><geom size=".05" pos="0 .1 0"/></body></body></body>""",
    extra='<equality><connect body1="fore" body2="world" anchor=".3 0 0"/><joint joint1="b" joint2="c" polycoef="0 .3 .4 0 0"/></equality>'
    + '<actuator><general joint="a" dyntype="filter" dynprm=".1" gainprm="2"/></actuator>'
    + rigid_models.touching(("floor", "tip")),
)


@jax.jit
def hop(model, state, ctrl):
    return rigid.step(model, state, ctrl, num_substeps=2)
