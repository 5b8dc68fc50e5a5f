"""Articulated rigid bodies in reduced coordinates: kinematics, inertia and inverse dynamics of a tree.

Everything that runs over the tree is a product with a constant matrix of zeros and ones (which joint moves which body),
and poses are composed along all chains at once in log2(depth) rounds, so programs stay small whatever the tree.

Conventions are MuJoCo's: free and ball joints are unit quaternions (w, x, y, z), angular velocities of free and ball
joints are in the body's frame, spatial vectors are [angular, linear] in world axes about the centre of mass of the
body's whole tree, which keeps rounding small far from the origin.

Source: Featherstone 2008, Rigid Body Dynamics Algorithms, chapters 5 and 6; layout as in MuJoCo's documentation.
"""

import dataclasses
import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.rotations import quaternion_product, quaternion_to_matrix, skew
from rewax.types import Array, Scalar


class JointType(enum.IntEnum):
    """Kinds of joints, numbered as MuJoCo does."""

    FREE = 0
    BALL = 1
    SLIDE = 2
    HINGE = 3


_QPOS_SIZE = {JointType.FREE: 7, JointType.BALL: 4, JointType.SLIDE: 1, JointType.HINGE: 1}
_DOF_SIZE = {JointType.FREE: 6, JointType.BALL: 3, JointType.SLIDE: 1, JointType.HINGE: 1}


@dataclasses.dataclass(frozen=True, eq=False)
class Topology:
    """What is fixed about a tree; body 0 is the world, a link is a joint with the frame it moves.

    Attributes:
      joint_type: of each joint, shape (num_joints,).
      links: for each link its joint (-1: none), body and whether it is its body's first; link 0 is the world.
      ancestors: links 2^k steps towards the world, one array of shape (num_links,) per round.
      body_link: last link of each body, whose frame is the body's, shape (num_bodies,).
      body_root: the outermost moving ancestor of each body, shape (num_bodies,).
      dof_body, dof_link: body and link of each degree of freedom; the link of a free joint's translation is the world.
      dof_axis: local axis where no joint axis gives it (free and ball joints), shape (num_dofs, 3).
      dof_joint: joint of each degree of freedom.
      dof_turns: whether it turns or slides, shape (num_dofs,).
      moves: 1 where a degree of freedom moves a body, shape (num_bodies, num_dofs).
      before: 1 where one degree of freedom moves the axis of another, shape (num_dofs, num_dofs).
      subtree: 1 where a body hangs on another or is it, shape (num_bodies, num_bodies).
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
        return [j for j, t in enumerate(self.joint_type) if _is_ball(t)]

    @property
    def quaternions(self) -> list[tuple[int, int]]:
        """Where the quaternion of each of ``ball_joints`` and its three rates begin."""
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
        """Where each joint's coordinates begin, shape (num_joints,)."""
        sizes = [_QPOS_SIZE[JointType(t)] for t in self.joint_type]
        return np.cumsum([0, *sizes])[:-1].astype(int)


def make_topology(body_parent: np.ndarray, joint_body: np.ndarray, joint_type: np.ndarray) -> Topology:
    """Tables of a tree.

    Args:
      body_parent: of each body, smaller than its own number; the world is 0.
      joint_body, joint_type: of each joint, ordered by body.
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

    return Topology(
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


def _is_ball(joint_type):
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
    """Numbers of a tree, named as in MuJoCo's model; rows of body 0 do not count."""

    qpos0: Array
    """Joint positions for which hinges and slides are at zero, shape (num_positions,)."""
    body_pos: Array
    """Frame of each body in its parent's [m], shape (num_bodies, 3)."""
    body_quat: Array
    body_ipos: Array
    """Centre of mass in the body's frame [m], shape (num_bodies, 3), and principal axes of inertia."""
    body_iquat: Array
    body_mass: Array
    """[kg], shape (num_bodies,)."""
    body_inertia: Array
    """Principal moments of inertia [kg m^2], shape (num_bodies, 3)."""
    jnt_pos: Array
    """Anchor of each joint in its body's frame [m], shape (num_joints, 3), and unit axis."""
    jnt_axis: Array
    dof_armature: Array
    """Inertia added to each degree of freedom [kg m^2 or kg], shape (num_dofs,)."""


class Kinematics(NamedTuple):
    """Where bodies are, and what moves them. Gradient: exact with respect to positions and parameters."""

    position: Array
    """Origin of each body's frame [m], shape (num_bodies, 3)."""
    rotation: Array
    """From each body's frame to the world's, shape (num_bodies, 3, 3)."""
    com: Array
    """Centre of mass of each body [m], shape (num_bodies, 3)."""
    inertia_rotation: Array
    """From each body's principal axes to the world's, shape (num_bodies, 3, 3)."""
    subtree_com: Array
    """Centre of mass of each body with all that hangs on it [m], shape (num_bodies, 3)."""
    tree_com: Array
    """The same of the body's outermost ancestor: where its spatial vectors are taken, shape (num_bodies, 3)."""
    axes: Array
    """Spatial velocity of what a degree of freedom moves, at unit rate, shape (num_dofs, 6)."""


def kinematics(topology: Topology, parameters: TreeParameters, qpos: Array) -> Kinematics:
    """Poses of all bodies and axes of all joints.

    Args:
      topology: the tree.
      parameters: its numbers.
      qpos: joint positions [m, rad, quaternions], shape (num_positions,); quaternions need not be unit.
    """
    links = _link_frames(topology, parameters, qpos)
    bodies = select(topology.body_link, links)
    position, rotation = bodies[:, :3, 3], bodies[:, :3, :3]
    com = position + rotate(rotation, parameters.body_ipos)
    mass = parameters.body_mass[:, None]
    subtree_mass = _dot(topology.subtree, mass)
    subtree_mass = jnp.where(subtree_mass > 0, subtree_mass, 1.0)  # of what has no mass, the place is not used
    subtree_com = _dot(topology.subtree, mass * com) / subtree_mass
    tree_com = select(topology.body_root, subtree_com)
    dof_frame = select(topology.dof_link, links)
    local_axis, anchor = _dof_axes(topology, parameters)
    axis = rotate(dof_frame[:, :3, :3], local_axis)
    offset = select(topology.dof_body, tree_com) - dof_frame[:, :3, 3] - rotate(dof_frame[:, :3, :3], anchor)
    turns = topology.dof_turns[:, None]
    axes = jnp.concatenate([jnp.where(turns, axis, 0.0), jnp.where(turns, cross(axis, offset), axis)], axis=-1)
    return Kinematics(
        position=position,
        rotation=rotation,
        com=com,
        inertia_rotation=compose(rotation, quaternion_to_matrix(parameters.body_iquat)),
        subtree_com=subtree_com,
        tree_com=tree_com,
        axes=axes,
    )


def body_velocities(topology: Topology, kin: Kinematics, rates: Array) -> Array:
    """Spatial velocity [rad/s, m/s] of each body at its tree's centre of mass, shape (num_bodies, 6).

    Args:
      topology, kin: the tree and where it is.
      rates: velocities, or anything else per degree of freedom, shape (num_dofs,). The result is linear in them.
    """
    return _dot(topology.moves, kin.axes * rates[:, None])


def generalized_forces(topology: Topology, kin: Kinematics, wrenches: Array) -> Array:
    """Forces on the degrees of freedom that do the same work as wrenches on bodies, shape (num_dofs,).

    Args:
      topology, kin: the tree and where it is.
      wrenches: torque about the tree's centre of mass [N m] and force [N] on each body, shape (num_bodies, 6).
    """
    return jnp.sum(kin.axes * _dot(topology.moves.T, wrenches), axis=-1)


def wrenches_at(kin: Kinematics, body: Array, point: Array, force: Array, num_bodies: int) -> Array:
    """Wrenches, as ``generalized_forces`` takes them, of forces [N] at points [m] of bodies, shape (num_bodies, 6).

    Args:
      kin: where the bodies are.
      body: which body each force acts on, shape (n,), int.
      point, force: in world axes, shape (n, 3).
      num_bodies: of the tree.
    """
    onehot = jax.nn.one_hot(body, num_bodies, dtype=force.dtype)
    arm = point - _dot(onehot, kin.tree_com)
    return _dot(onehot.T, jnp.concatenate([cross(arm, force), force], axis=-1))


def point_velocities(kin: Kinematics, velocities: Array, body: Array, point: Array) -> Array:
    """Velocity of points that move with bodies [m/s], shape (n, 3).

    Args:
      kin: where the bodies are.
      velocities: their spatial velocities, shape (num_bodies, 6).
      body: which body each point belongs to, shape (n,), int.
      point: in the world [m], shape (n, 3).
    """
    onehot = jax.nn.one_hot(body, velocities.shape[0], dtype=point.dtype)
    velocity = _dot(onehot, velocities)
    return velocity[:, 3:] + cross(velocity[:, :3], point - _dot(onehot, kin.tree_com))


def point_drifts(topology: Topology, kin: Kinematics, qvel: Array, body: Array, point: Array) -> Array:
    """Acceleration of points that move with bodies while all joints keep their rates [m/s^2], shape (n, 3).

    Args:
      topology, kin: the tree and where it is.
      qvel: joint velocities [m/s, rad/s], shape (num_dofs,).
      body: which body each point belongs to, shape (n,), int.
      point: in the world [m], shape (n, 3).
    """
    velocity = body_velocities(topology, kin, qvel)
    drift = point_velocities(kin, _dot(topology.moves, _axis_drifts(topology, kin, qvel)), body, point)
    turning = _dot(jax.nn.one_hot(body, velocity.shape[0], dtype=point.dtype), velocity[:, :3])
    return drift + cross(turning, point_velocities(kin, velocity, body, point))


def mass_matrix(topology: Topology, parameters: TreeParameters, kin: Kinematics) -> Array:
    """Joint-space inertia, symmetric and positive definite, shape (num_dofs, num_dofs)."""
    num_bodies, num_dofs = topology.moves.shape
    mass, arm = parameters.body_mass[:, None], kin.com - kin.tree_com
    turned = skew(arm)
    inertia = _rotational_inertia(parameters, kin) - mass[:, :, None] * compose(turned, turned)
    # Inertia about the tree's centre of mass, first moment and mass of all that a degree of freedom carries.
    moments = jnp.concatenate([inertia.reshape(num_bodies, 9), mass * arm, mass], axis=-1)
    carried = _dot(topology.subtree[topology.dof_body], moments)
    inertia, moment, mass = carried[:, :9].reshape(num_dofs, 3, 3), carried[:, 9:12], carried[:, 12:]
    angular, linear = kin.axes[:, :3], kin.axes[:, 3:]
    torque = rotate(inertia, angular) + cross(moment, linear)
    force = jnp.concatenate([torque, mass * linear - cross(moment, angular)], axis=-1)
    carries = topology.moves[topology.dof_body] * np.tri(num_dofs, k=-1)  # earlier dofs that move another's body
    lower = _dot(force, kin.axes.T) * carries
    return lower + lower.T + jnp.diag(jnp.sum(force * kin.axes, axis=-1) + parameters.dof_armature)


def inverse_dynamics(
    topology: Topology,
    parameters: TreeParameters,
    kin: Kinematics,
    qvel: Array,
    qacc: Array,
    gravity: Array,
) -> Array:
    """Generalized forces that make the tree accelerate so, shape (num_dofs,).

    Args:
      topology, parameters, kin: the tree and where it is.
      qvel: joint velocities [m/s, rad/s], shape (num_dofs,).
      qacc: joint accelerations [m/s^2, rad/s^2], shape (num_dofs,). The result is affine in them, with the mass matrix.
      gravity: [m/s^2], shape (3,).

    Source: recursive Newton-Euler, Featherstone 2008, table 5.1, with sums over chains for its recursions.
    """
    velocity = body_velocities(topology, kin, qvel)
    change = _axis_drifts(topology, kin, qvel) + kin.axes * qacc[:, None]
    acceleration = _dot(topology.moves, change) - jnp.concatenate([jnp.zeros(3, gravity.dtype), gravity])
    inertia = _rotational_inertia(parameters, kin)
    arm, mass = kin.com - kin.tree_com, parameters.body_mass[:, None]

    def momentum(motion: Array) -> Array:
        angular, linear = motion[:, :3], motion[:, 3:]
        p = mass * (linear + cross(angular, arm))
        return jnp.concatenate([rotate(inertia, angular) + cross(arm, p), p], axis=-1)

    wrenches = momentum(acceleration) + _force_cross(velocity, momentum(velocity))
    return generalized_forces(topology, kin, wrenches) + parameters.dof_armature * qacc


def integrate(topology: Topology, qpos: Array, qvel: Array, dt: Scalar) -> Array:
    """Joint positions after moving with constant velocities for a time dt [s]; quaternions come out normalised."""
    moved = qpos + dt * _dot(topology.coordinate_of_dof, qvel)
    for quaternion, turn in topology.quaternions:
        moved = moved.at[quaternion : quaternion + 4].set(
            _turn(qpos[quaternion : quaternion + 4], dt * qvel[turn : turn + 3])
        )
    return moved


def _link_frames(topology: Topology, parameters: TreeParameters, qpos: Array) -> Array:
    """Pose of every link in the world as a homogeneous matrix, shape (num_links, 4, 4)."""
    joint, has_joint = np.maximum(topology.link_joint, 0), topology.link_joint >= 0
    kind = topology.joint_type[joint] if len(topology.joint_type) else np.zeros_like(joint)
    hinge, slide = has_joint & (kind == JointType.HINGE), has_joint & (kind == JointType.SLIDE)
    free = has_joint & (kind == JointType.FREE)
    num_links, eye = len(joint), jnp.eye(3, dtype=qpos.dtype)
    coordinate = np.zeros((num_links, topology.num_positions))
    scalar = hinge | slide
    coordinate[scalar, topology.joint_qpos[joint[scalar]]] = 1.0
    amount = _dot(coordinate, qpos - parameters.qpos0)[:, None, None]
    axis, anchor = (
        select(joint, a) if len(topology.joint_type) else jnp.zeros((num_links, 3), qpos.dtype)
        for a in (parameters.jnt_axis, parameters.jnt_pos)
    )
    generator = skew(axis)
    turned = jnp.sin(amount) * generator + (1.0 - jnp.cos(amount)) * compose(generator, generator)
    rotation = eye + jnp.where(hinge[:, None, None], turned, 0.0)
    for quaternion, joint_number in zip([q for q, _ in topology.quaternions], topology.ball_joints, strict=True):
        row = (topology.link_joint == joint_number).astype(float)[:, None, None]
        rotation = rotation + row * (quaternion_to_matrix(_unit(qpos[quaternion : quaternion + 4])) - eye)
    shift = anchor - rotate(rotation, anchor) + jnp.where(slide[:, None], axis * amount[:, :, 0], 0.0)
    for joint_number in np.flatnonzero(topology.joint_type == JointType.FREE):
        row, start = (topology.link_joint == joint_number).astype(float)[:, None], topology.joint_qpos[joint_number]
        shift = shift + row * qpos[start : start + 3]
    offset = (topology.link_first & ~free)[:, None]
    frame = jnp.where(offset[:, :, None], quaternion_to_matrix(select(topology.link_body, parameters.body_quat)), eye)
    origin = jnp.where(offset, select(topology.link_body, parameters.body_pos), 0.0)
    links = jnp.concatenate([compose(frame, rotation), (origin + rotate(frame, shift))[:, :, None]], axis=-1)
    for ancestor in topology.ancestors:
        before = select(ancestor, links)
        links = compose(before[:, :, :3], links) + before * np.array([0.0, 0.0, 0.0, 1.0])
    return links


def _dof_axes(topology: Topology, parameters: TreeParameters) -> tuple[Array, Array]:
    """Axis and anchor of each degree of freedom in its link's frame, shape (num_dofs, 3) each."""
    given = ~_is_ball(topology.joint_type[topology.dof_joint])[:, None]
    free = (topology.joint_type[topology.dof_joint] == JointType.FREE)[:, None]
    axis = select(topology.dof_joint, parameters.jnt_axis)
    axis = jnp.where(given, axis, jnp.asarray(topology.dof_axis, axis.dtype))
    return axis, jnp.where(free, 0.0, select(topology.dof_joint, parameters.jnt_pos))


def _rotational_inertia(parameters: TreeParameters, kin: Kinematics) -> Array:
    """About each body's centre of mass, in world axes [kg m^2], shape (num_bodies, 3, 3)."""
    axes = kin.inertia_rotation
    return compose(axes * parameters.body_inertia[:, None, :], jnp.swapaxes(axes, -1, -2))


def _axis_drifts(topology: Topology, kin: Kinematics, qvel: Array) -> Array:
    """Rate of change of each joint's axis, times its rate: velocity-product accelerations, shape (num_dofs, 6)."""
    carried = _dot(topology.before, kin.axes * qvel[:, None])  # what moves an axis turns it
    return _motion_cross(carried, kin.axes) * qvel[:, None]


def _motion_cross(a: Array, b: Array) -> Array:
    """Rate of change of spatial motions b that move with velocity a, shape (n, 6)."""
    w, v = a[:, :3], a[:, 3:]
    return jnp.concatenate([cross(w, b[:, :3]), cross(w, b[:, 3:]) + cross(v, b[:, :3])], axis=-1)


def _force_cross(a: Array, f: Array) -> Array:
    """Rate of change of spatial forces f = [torque, force] that move with velocity a, shape (n, 6)."""
    w, v = a[:, :3], a[:, 3:]
    return jnp.concatenate([cross(w, f[:, :3]) + cross(v, f[:, 3:]), cross(w, f[:, 3:])], axis=-1)


def _turn(q: Array, angle: Array) -> Array:
    """Unit quaternion after turning by a vector of angles [rad] in the body's frame. Gradient: exact, at rest too."""
    square = 0.25 * jnp.sum(angle * angle)
    small = square < 1e-6
    half = jnp.sqrt(jnp.where(small, 1.0, square))
    sine = jnp.where(small, 1.0 - square / 6.0 * (1.0 - square / 20.0), jnp.sin(half) / half)
    cosine = jnp.where(small, 1.0 - square / 2.0 * (1.0 - square / 12.0), jnp.cos(half))
    return _unit(quaternion_product(_unit(q), jnp.concatenate([cosine[None], 0.5 * sine * angle])))


def _unit(q: Array) -> Array:
    return q / jnp.sqrt(jnp.sum(q * q))


def cross(a: Array, b: Array) -> Array:
    """Cross products along the last axis, of length 3."""
    return jnp.sum(skew(a) * b[..., None, :], axis=-1)


def _dot(a: np.ndarray | Array, b: Array) -> Array:
    """Matrix product in full precision (accelerators round float32 products otherwise)."""
    return jnp.matmul(jnp.asarray(a, b.dtype), b, precision=jax.lax.Precision.HIGHEST)


def select(index: np.ndarray, table: Array) -> Array:
    """``table[index]`` for a constant index; as a matrix product, whose transpose needs no scatter."""
    onehot = np.eye(table.shape[0])[index]
    return _dot(onehot, table.reshape(table.shape[0], -1)).reshape(len(index), *table.shape[1:])


def compose(a: Array, b: Array) -> Array:
    """Products of small matrices, (..., n, n) each; as one reduction that fuses."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def rotate(a: Array, v: Array) -> Array:
    """Products of small matrices and vectors, (..., n, n) and (..., n)."""
    return jnp.sum(a * v[..., None, :], axis=-1)
