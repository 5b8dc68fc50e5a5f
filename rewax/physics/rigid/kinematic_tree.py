"""Trees of rigid bodies in reduced coordinates: topology and parameters.

Sums over the tree are products with constant matrices of zeros and ones (``moves``: which joint moves which body).
Conventions are MuJoCo's: orientations of free and ball joints are unit quaternions (w, x, y, z), their angular
velocities are in the body's frame.
"""

import dataclasses
import enum
from typing import NamedTuple

import numpy as np

from rewax.types import Array


class JointType(enum.IntEnum):
    """Kinds of joints, numbered as in MuJoCo."""

    FREE = 0
    BALL = 1
    SLIDE = 2
    HINGE = 3


_QPOS_SIZE = {JointType.FREE: 7, JointType.BALL: 4, JointType.SLIDE: 1, JointType.HINGE: 1}
_DOF_SIZE = {JointType.FREE: 6, JointType.BALL: 3, JointType.SLIDE: 1, JointType.HINGE: 1}


@dataclasses.dataclass(frozen=True, eq=False)
class TreeTopology:
    """The static part of a tree. Body 0 is the world. A link is a joint together with the frame that it moves.

    Attributes:
      joint_type: type of each joint, shape (num_joints,).
      link_joint, link_body, link_first: joint (-1: none) and body of each link, and whether it is its body's first;
        link 0 is the world.
      ancestors: the link 2^k steps towards the world, one array of shape (num_links,) for each k.
      body_link: last link of each body, shape (num_bodies,). Its frame is the body's frame.
      body_root: the outermost moving ancestor of each body, shape (num_bodies,).
      dof_body, dof_link: body and link of each degree of freedom; the link of a free joint's translation is the world.
      dof_axis: local axis where no joint axis gives it (free and ball joints), shape (num_dofs, 3).
      dof_joint: joint of each degree of freedom.
      dof_turns: whether a degree of freedom rotates (else it translates), shape (num_dofs,).
      moves: 1 where a degree of freedom moves a body, shape (num_bodies, num_dofs).
      before: 1 where one degree of freedom moves the axis of another, shape (num_dofs, num_dofs).
      subtree: 1 where body j is in the subtree of body i (i included), shape (num_bodies, num_bodies).
    """

    joint_type: np.ndarray
    link_joint: np.ndarray
    link_body: np.ndarray
    link_first: np.ndarray
    ancestors: tuple[np.ndarray, ...]
    body_link: np.ndarray
    body_root: np.ndarray
    dof_body: np.ndarray
    dof_link: np.ndarray
    dof_axis: np.ndarray
    dof_joint: np.ndarray
    dof_turns: np.ndarray
    moves: np.ndarray
    before: np.ndarray
    subtree: np.ndarray

    @property
    def num_positions(self) -> int:
        return sum(_QPOS_SIZE[JointType(t)] for t in self.joint_type)

    @property
    def ball_joints(self) -> list[int]:
        """Joints with a quaternion."""
        return [j for j, t in enumerate(self.joint_type) if is_ball(t)]

    @property
    def quaternions(self) -> list[tuple[int, int]]:
        """Start of the quaternion in qpos and of its three rates in qvel, for each of ``ball_joints``."""
        dof = np.cumsum([0] + [_DOF_SIZE[JointType(t)] for t in self.joint_type])
        skip = {JointType.FREE: 3, JointType.BALL: 0}
        return [
            (int(self.joint_qpos[j]) + skip[self.joint_type[j]], int(dof[j]) + skip[self.joint_type[j]])
            for j in self.ball_joints
        ]

    @property
    def coordinate_of_dof(self) -> np.ndarray:
        """1 where a position is the integral of a rate, shape (num_positions, num_dofs)."""
        table = np.zeros((self.num_positions, len(self.dof_joint)))
        dof = np.cumsum([0] + [_DOF_SIZE[JointType(t)] for t in self.joint_type])
        for joint, kind in enumerate(self.joint_type):
            for k in range({JointType.FREE: 3, JointType.BALL: 0}.get(kind, 1)):
                table[self.joint_qpos[joint] + k, dof[joint] + k] = 1.0
        return table

    @property
    def joint_qpos(self) -> np.ndarray:
        """Offset of each joint's coordinates in qpos, shape (num_joints,)."""
        sizes = [_QPOS_SIZE[JointType(t)] for t in self.joint_type]
        return np.cumsum([0, *sizes])[:-1].astype(int)


def tree_topology(body_parent: np.ndarray, joint_body: np.ndarray, joint_type: np.ndarray) -> TreeTopology:
    """The topology of a tree.

    Args:
      body_parent: parent of each body, smaller than the body's own index; the world is 0.
      joint_body, joint_type: body and type of each joint, ordered by body.
    """
    num_bodies, num_joints = len(body_parent), len(joint_type)
    link_joint, link_body, link_first, link_parent = [-1], [0], [False], [0]
    body_link = np.zeros(num_bodies, int)
    for body in range(1, num_bodies):
        joints = [j for j in range(num_joints) if joint_body[j] == body] or [-1]
        for i, joint in enumerate(joints):
            link_parent.append(int(body_link[body_parent[body]]) if i == 0 else len(link_joint) - 1)
            link_joint.append(joint)
            link_body.append(body)
            link_first.append(i == 0)
        body_link[body] = len(link_joint) - 1

    dofs = [(j, k) for j in range(num_joints) for k in range(_DOF_SIZE[JointType(joint_type[j])])]
    joint_link = {j: link for link, j in enumerate(link_joint) if j >= 0}
    chain = {0: []}  # joints from the world to a link, itself included
    for link in range(1, len(link_joint)):
        chain[link] = chain[link_parent[link]] + ([link_joint[link]] if link_joint[link] >= 0 else [])

    def translates(joint: int, k: int) -> bool:
        return joint_type[joint] == JointType.FREE and k < 3

    def moves_axis(joint: int, k: int, other: int, o: int) -> bool:
        """Whether dof (other, o) moves the axis of (joint, k)."""
        if joint == other:
            return joint_type[joint] == JointType.FREE and k >= 3 and o < 3
        return other in chain[link_parent[joint_link[joint]]] and not translates(joint, k)

    return TreeTopology(
        joint_type=np.asarray(joint_type, int),
        link_joint=np.array(link_joint),
        link_body=np.array(link_body),
        link_first=np.array(link_first),
        ancestors=_ancestors(np.array(link_parent)),
        body_link=body_link,
        body_root=_roots(body_parent),
        dof_body=np.array([joint_body[j] for j, _ in dofs], int),
        dof_link=np.array([0 if translates(j, k) else joint_link[j] for j, k in dofs], int),
        dof_axis=np.array([np.eye(3)[k % 3] for _, k in dofs]).reshape(-1, 3),
        dof_joint=np.array([j for j, _ in dofs], int),
        dof_turns=np.array([joint_type[j] != JointType.SLIDE and not translates(j, k) for j, k in dofs], bool),
        moves=np.array([[j in chain[body_link[b]] for j, _ in dofs] for b in range(num_bodies)], float),
        before=np.array([[moves_axis(*dof, *other) for other in dofs] for dof in dofs], float).reshape(len(dofs), -1),
        subtree=_subtree(body_parent),
    )


def is_ball(joint_type):
    return (joint_type == JointType.FREE) | (joint_type == JointType.BALL)


def _ancestors(parent: np.ndarray) -> tuple[np.ndarray, ...]:
    rounds = []
    while parent.any():
        rounds.append(parent)
        parent = parent[parent]
    return tuple(rounds)


def _roots(body_parent: np.ndarray) -> np.ndarray:
    root = np.arange(len(body_parent))
    for body in range(1, len(body_parent)):
        if body_parent[body] != 0:
            root[body] = root[body_parent[body]]
    return root


def _subtree(body_parent: np.ndarray) -> np.ndarray:
    inside = np.eye(len(body_parent))
    for body in range(len(body_parent) - 1, 0, -1):
        inside[body_parent[body]] += inside[body]
    return inside


class TreeParameters(NamedTuple):
    """Parameters of a tree, named as in MuJoCo's model. Rows of body 0 are ignored."""

    qpos0: Array
    """Joint positions at which hinges and slides are at zero, shape (num_positions,)."""
    body_pos: Array
    """Frame of each body in its parent's [m], shape (num_bodies, 3)."""
    body_quat: Array
    """Orientation of each body in its parent's frame, shape (num_bodies, 4)."""
    body_ipos: Array
    """Center of mass in the body's frame [m], shape (num_bodies, 3)."""
    body_iquat: Array
    """Orientation of the principal axes of inertia in the body's frame, shape (num_bodies, 4)."""
    body_mass: Array
    """Mass of each body [kg], shape (num_bodies,)."""
    body_inertia: Array
    """Principal moments of inertia [kg m^2], shape (num_bodies, 3)."""
    jnt_pos: Array
    """Anchor of each joint in its body's frame [m], shape (num_joints, 3)."""
    jnt_axis: Array
    """Unit axis of each joint in its body's frame, shape (num_joints, 3)."""
    dof_armature: Array
    """Inertia added to each degree of freedom [kg m^2 or kg], shape (num_dofs,)."""
