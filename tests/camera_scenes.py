"""Scenes that sensors are tested on, as MJCF and as what a camera sees of it."""

import jax.numpy as jnp
import mujoco
import numpy as np

from rewax.sensors import Camera

HEAD = (
    '<mujoco><visual><quality numslices="256" numstacks="256" numquads="1"/></visual><asset>{asset}</asset><worldbody>'
)
TAIL = "</worldbody></mujoco>"
_MESH = '<mesh name="rock" vertex="-.2 -.1 -.1  .2 -.15 -.1  .15 .2 -.12  -.1 .2 -.1  .02 .03 .25  -.15 .05 .15  .18 0 .1"/>'
SCENES = {
    "balls": '<geom type="sphere" size=".2" pos="0 0 .2"/><geom type="sphere" size=".1" pos=".3 .2 .5"/>',
    "boxes": '<geom type="box" size=".2 .1 .15" euler="20 30 40"/><geom type="box" size=".05 .3 .05" pos=".2 .1 .3"/>',
    "capsules": '<geom type="capsule" size=".1 .25" euler="70 10 0"/><geom type="capsule" size=".05 .1" pos=".3 0 .3"/>',
    "cylinders": '<geom type="cylinder" size=".15 .2" euler="50 20 0"/><geom type="cylinder" size=".3 .02" pos="0 0 -.3"/>',
    "ellipsoids": '<geom type="ellipsoid" size=".3 .1 .2" euler="10 40 0"/><geom type="ellipsoid" size=".1 .1 .02" pos="0 0 .4"/>',
    "ground and mesh": '<geom type="plane" size="0 0 .1" pos="0 0 -.3"/><geom type="mesh" mesh="rock" euler="0 20 30"/>',
}
EYE, TARGET, UP = (1.0, -1.1, 0.9), (0.0, 0.0, 0.05), (0.0, 0.0, 1.0)
FAR = 5.0
CAMERA = Camera.look_at(TARGET, eye=EYE, up=UP, near=0.3, far=FAR, height=48, width=64)
STRAIGHT = jnp.eye(3)


def mjcf(name: str) -> str:
    """The scene with a camera that ``EYE``, ``TARGET`` and ``UP`` describe, and a hidden joint, which a model needs."""
    back = np.subtract(EYE, TARGET) / np.linalg.norm(np.subtract(EYE, TARGET))
    right = np.cross(UP, back) / np.linalg.norm(np.cross(UP, back))
    axes = " ".join(str(a) for a in (*right, *np.cross(back, right)))
    eye = " ".join(str(a) for a in EYE)
    camera = f'<camera name="eye" pos="{eye}" xyaxes="{axes}" fovy="45"/>'
    joint = '<body pos="9 9 9"><joint type="slide"/><geom type="sphere" size=".01"/></body>'
    return HEAD.format(asset=_MESH if "mesh" in name else "") + SCENES[name] + camera + joint + TAIL


def ray_depth(model: mujoco.MjModel, directions: np.ndarray, forward: np.ndarray, far: float) -> np.ndarray:
    """Depth of rays from ``EYE`` by MuJoCo's own rays [m], shape (n,)."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom, unit = np.zeros(1, np.int32), directions / np.linalg.norm(directions, axis=1, keepdims=True)
    found = np.array([mujoco.mj_ray(model, data, np.array(EYE), d, None, 1, -1, geom) for d in unit])
    return np.where(found < 0, far, np.minimum(found * (unit @ forward), far))
