"""Forward kinematics of a tree of bodies: poses, velocities, spatial axes of the joints.

Poses are composed along all chains at once in log2(depth) rounds, so programs stay small for any tree. Spatial vectors
are [angular, linear] in world axes about the center of mass of the body's whole tree. This keeps rounding errors small
far from the origin.

Source: Featherstone 2008, Rigid Body Dynamics Algorithms, chapters 2 and 4; layout as in MuJoCo's documentation.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.structural import structural_zeros
from rewax.physics.numerics.rotations import normalized, quaternion_product, quaternion_to_matrix, skew
from rewax.physics.rigid.kinematic_tree import JointType, TreeParameters, TreeTopology, is_ball
from rewax.physics.rigid.small_products import compose, cross, dot, rotate, select
from rewax.types import Array, Scalar


class Kinematics(NamedTuple):
    """Poses of bodies and spatial axes of joints. Gradient: exact with respect to positions and parameters."""

    position: Array
    """Origin of each body's frame [m], shape (num_bodies, 3)."""
    rotation: Array
    """From each body's frame to the world's, shape (num_bodies, 3, 3)."""
    com: Array
    """Center of mass of each body [m], shape (num_bodies, 3)."""
    inertia_rotation: Array
    """From each body's principal axes to the world's, shape (num_bodies, 3, 3)."""
    subtree_com: Array
    """Center of mass of each body's subtree [m], shape (num_bodies, 3)."""
    tree_com: Array
    """Center of mass of each body's whole tree [m], the reference of its spatial vectors, shape (num_bodies, 3)."""
    axes: Array
    """Spatial axis of each degree of freedom: velocity of the bodies that it moves, per unit rate, (num_dofs, 6)."""


def kinematics(topology: TreeTopology, parameters: TreeParameters, qpos: Array) -> Kinematics:
    """Poses of all bodies and axes of all joints.

    Args:
      topology: the tree.
      parameters: its parameters.
      qpos: joint positions [m, rad, quaternions], shape (num_positions,); quaternions may have any length.
    """
    links = _link_frames(topology, parameters, qpos)
    bodies = select(topology.body_link, links)
    position, rotation = bodies[:, :3, 3], bodies[:, :3, :3]
    com = position + rotate(rotation, parameters.body_ipos)
    mass = parameters.body_mass[:, None]
    subtree_mass = dot(topology.subtree, mass)
    subtree_mass = jnp.where(subtree_mass > 0, subtree_mass, 1.0)  # massless subtree: its center of mass is never read
    subtree_com = dot(topology.subtree, mass * com) / subtree_mass
    tree_com = select(topology.body_root, subtree_com)
    dof_frame = select(topology.dof_link, links)
    local_axis, anchor = _dof_axes(topology, parameters)
    axis = rotate(dof_frame[:, :3, :3], local_axis)
    offset = select(topology.dof_body, tree_com) - dof_frame[:, :3, 3] - rotate(dof_frame[:, :3, :3], anchor)
    turns = topology.dof_turns[:, None]
    axes = jnp.concatenate([jnp.where(turns, axis, 0.0), jnp.where(turns, cross(axis, offset), axis)], axis=-1)
    axes = structural_zeros(axes)
    return Kinematics(
        position=position,
        rotation=rotation,
        com=com,
        inertia_rotation=compose(rotation, quaternion_to_matrix(parameters.body_iquat)),
        subtree_com=subtree_com,
        tree_com=tree_com,
        axes=axes,
    )


def body_velocities(topology: TreeTopology, kin: Kinematics, rates: Array) -> Array:
    """Spatial velocity [rad/s, m/s] of each body at its tree's center of mass, shape (num_bodies, 6).

    Args:
      topology, kin: the tree and its kinematics.
      rates: velocities, or another vector over degrees of freedom, shape (num_dofs,). The result is linear in them.
    """
    return dot(topology.moves, kin.axes * rates[:, None])


def generalized_forces(topology: TreeTopology, kin: Kinematics, wrenches: Array) -> Array:
    """Generalized forces that do the same work as wrenches on bodies, shape (num_dofs,).

    Args:
      topology, kin: the tree and its kinematics.
      wrenches: torque about the tree's center of mass [N m] and force [N] on each body, shape (num_bodies, 6).
    """
    return jnp.sum(kin.axes * dot(topology.moves.T, wrenches), axis=-1)


def point_velocities(kin: Kinematics, velocities: Array, body: Array, point: Array) -> Array:
    """Velocity of points that move with bodies [m/s], shape (n, 3).

    Args:
      kin: kinematics of the tree.
      velocities: spatial velocities of the bodies, shape (num_bodies, 6).
      body: index of each point's body, shape (n,), int.
      point: positions in the world [m], shape (n, 3).
    """
    return moving_points(kin, velocities, body, point)[0]


def moving_points(
    kin: Kinematics, velocities: Array, body: Array, point: Array
) -> tuple[Array, Callable[[Array], Array]]:
    """Velocities as ``point_velocities`` returns them, and a function from forces to wrenches.

    The function maps forces at the points [N], world axes, shape (n, 3), to wrenches on the bodies for
    ``generalized_forces``, shape (num_bodies, 6).
    """
    onehot = structural_zeros(jax.nn.one_hot(body, velocities.shape[0], dtype=point.dtype))
    carried = dot(onehot, jnp.concatenate([velocities, kin.tree_com], axis=-1))
    arm = point - carried[:, 6:]

    def wrenches(force: Array) -> Array:
        return dot(onehot.T, jnp.concatenate([cross(arm, force), force], axis=-1))

    return carried[:, 3:6] + cross(carried[:, :3], arm), wrenches


def point_drifts(topology: TreeTopology, kin: Kinematics, qvel: Array, body: Array, point: Array) -> Array:
    """Acceleration of points that move with bodies while all joints keep their rates [m/s^2], shape (n, 3).

    Args:
      topology, kin: the tree and its kinematics.
      qvel: joint velocities [m/s, rad/s], shape (num_dofs,).
      body: index of each point's body, shape (n,), int.
      point: positions in the world [m], shape (n, 3).
    """
    velocity = body_velocities(topology, kin, qvel)
    drift = point_velocities(kin, dot(topology.moves, axis_drifts(topology, kin, qvel)), body, point)
    onehot = structural_zeros(jax.nn.one_hot(body, velocity.shape[0], dtype=point.dtype))
    turning = dot(onehot, velocity[:, :3])
    return drift + cross(turning, point_velocities(kin, velocity, body, point))


def integrate(topology: TreeTopology, qpos: Array, qvel: Array, dt: Scalar) -> Array:
    """Joint positions after motion with constant velocities for a time dt [s], with normalised quaternions."""
    moved = qpos + dt * dot(topology.coordinate_of_dof, qvel)
    for quaternion, turn in topology.quaternions:
        moved = moved.at[quaternion : quaternion + 4].set(
            _turn(qpos[quaternion : quaternion + 4], dt * qvel[turn : turn + 3])
        )
    return moved


def axis_drifts(topology: TreeTopology, kin: Kinematics, qvel: Array) -> Array:
    """Velocity-product acceleration of each axis: its rate of change times its rate, shape (num_dofs, 6)."""
    carried = dot(topology.before, kin.axes * qvel[:, None])  # velocity of the frame that carries the axis
    return _motion_cross(carried, kin.axes) * qvel[:, None]


def _motion_cross(a: Array, b: Array) -> Array:
    """Rate of change of spatial motions b that move with velocity a, shape (n, 6)."""
    w, v = a[:, :3], a[:, 3:]
    return jnp.concatenate([cross(w, b[:, :3]), cross(w, b[:, 3:]) + cross(v, b[:, :3])], axis=-1)


def _link_frames(topology: TreeTopology, parameters: TreeParameters, qpos: Array) -> Array:
    """Pose of every link in the world as a homogeneous matrix, shape (num_links, 4, 4)."""
    joint, has_joint = np.maximum(topology.link_joint, 0), topology.link_joint >= 0
    kind = topology.joint_type[joint] if len(topology.joint_type) else np.zeros_like(joint)
    hinge, slide = has_joint & (kind == JointType.HINGE), has_joint & (kind == JointType.SLIDE)
    free = has_joint & (kind == JointType.FREE)
    num_links, eye = len(joint), jnp.eye(3, dtype=qpos.dtype)
    coordinate = np.zeros((num_links, topology.num_positions))
    scalar = hinge | slide
    coordinate[scalar, topology.joint_qpos[joint[scalar]]] = 1.0
    amount = dot(coordinate, qpos - parameters.qpos0)[:, None, None]
    axis, anchor = (
        select(joint, a) if len(topology.joint_type) else jnp.zeros((num_links, 3), qpos.dtype)
        for a in (parameters.jnt_axis, parameters.jnt_pos)
    )
    generator = skew(axis)
    turned = jnp.sin(amount) * generator + (1.0 - jnp.cos(amount)) * compose(generator, generator)
    rotation = structural_zeros(eye + jnp.where(hinge[:, None, None], turned, 0.0))
    for quaternion, joint_number in zip([q for q, _ in topology.quaternions], topology.ball_joints, strict=True):
        row = structural_zeros(jnp.asarray(topology.link_joint == joint_number, qpos.dtype)[:, None, None])
        rotation = rotation + row * (quaternion_to_matrix(normalized(qpos[quaternion : quaternion + 4])) - eye)
    shift = anchor - rotate(rotation, anchor) + jnp.where(slide[:, None], axis * amount[:, :, 0], 0.0)
    shift = structural_zeros(shift)
    for joint_number in np.flatnonzero(topology.joint_type == JointType.FREE):
        row = structural_zeros(jnp.asarray(topology.link_joint == joint_number, qpos.dtype)[:, None])
        start = topology.joint_qpos[joint_number]
        shift = shift + row * qpos[start : start + 3]
    offset = (topology.link_first & ~free)[:, None]
    turned = quaternion_to_matrix(select(topology.link_body, parameters.body_quat))
    frame = structural_zeros(jnp.where(offset[:, :, None], turned, eye))
    origin = structural_zeros(jnp.where(offset, select(topology.link_body, parameters.body_pos), 0.0))
    links = jnp.concatenate([compose(frame, rotation), (origin + rotate(frame, shift))[:, :, None]], axis=-1)
    for ancestor in topology.ancestors:
        before = select(ancestor, links)
        links = compose(before[:, :, :3], links) + before * structural_zeros(
            jnp.array([0.0, 0.0, 0.0, 1.0], qpos.dtype)
        )
    return links


def _dof_axes(topology: TreeTopology, parameters: TreeParameters) -> tuple[Array, Array]:
    """Axis and anchor of each degree of freedom in its link's frame, shape (num_dofs, 3) each."""
    given = ~is_ball(topology.joint_type[topology.dof_joint])[:, None]
    free = (topology.joint_type[topology.dof_joint] == JointType.FREE)[:, None]
    axis = select(topology.dof_joint, parameters.jnt_axis)
    axis = jnp.where(given, axis, jnp.asarray(topology.dof_axis, axis.dtype))
    return axis, jnp.where(free, 0.0, select(topology.dof_joint, parameters.jnt_pos))


def _turn(q: Array, angle: Array) -> Array:
    """Unit quaternion after a rotation by a vector [rad] in the body's frame. Gradient: exact, also at zero."""
    square = 0.25 * jnp.sum(angle * angle)
    small = square < 1e-6
    half = jnp.sqrt(jnp.where(small, 1.0, square))
    sine = jnp.where(small, 1.0 - square / 6.0 * (1.0 - square / 20.0), jnp.sin(half) / half)
    cosine = jnp.where(small, 1.0 - square / 2.0 * (1.0 - square / 12.0), jnp.cos(half))
    return normalized(quaternion_product(normalized(q), jnp.concatenate([cosine[None], 0.5 * sine * angle])))
