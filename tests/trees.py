"""Trees of all kinds of joints, as MuJoCo and as rewax read them, for tests of kinematics and dynamics."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rewax.physics.rigid.kinematic_tree import TreeParameters, tree_topology
from rewax.physics.rigid.kinematics import (
    body_velocities,
    integrate,
    kinematics,
)
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
