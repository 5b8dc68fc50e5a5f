"""A record by hand, and the least that the checks of a record ask of an environment."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from rewax.identify.records import Record
from rewax.physics.contact import Collider
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Sphere


def body():
    """Corners and centres of a block of 0.3 m, shape (27, 3)."""
    axis = np.linspace(0.0, 0.3, 3)
    return np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)


def pushed():
    """Five frames and four steps of a body that moves by 1 cm a frame before a ball of radius 0.1 m."""
    clouds = body()[None] + 0.01 * np.arange(5)[:, None, None] * np.array([1.0, 0.0, 0.0])
    mask = np.ones(clouds.shape[:2], bool)
    mask[:, -1] = False
    joint_q = np.stack([-0.1 + 0.01 * np.arange(5), np.zeros(5)], -1)
    return Record(
        times=0.1 * np.arange(5), clouds=clouds, mask=mask, actions=np.ones((4, 2)), control_dt=0.1, joint_q=joint_q
    )


def pusher():
    """An environment in name: two joints, a ball that they move in the plane z = 0."""

    def poses(joint_q):
        position = jnp.stack([joint_q[:, 0], joint_q[:, 1], jnp.zeros(len(joint_q))], -1)
        return Pose(position[:, None], jnp.broadcast_to(jnp.eye(3), (len(joint_q), 1, 3, 3)))

    ball = Collider(shape=Sphere(radius=0.1), friction=0.5)
    return SimpleNamespace(
        action_spec=SimpleNamespace(shape=(2,)), control_dt=0.1, scene=SimpleNamespace(colliders=(ball,)), poses=poses
    )
