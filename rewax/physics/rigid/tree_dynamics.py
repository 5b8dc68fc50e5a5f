"""Mass matrix (CRBA) and inverse dynamics (RNEA) of a tree of rigid bodies.

Source: Featherstone 2008, Rigid Body Dynamics Algorithms, chapters 5 and 6.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.structural import structural_zeros
from rewax.physics.numerics.rotations import skew
from rewax.physics.rigid.kinematic_tree import TreeParameters, TreeTopology
from rewax.physics.rigid.kinematics import Kinematics, axis_drifts, body_velocities, generalized_forces
from rewax.physics.rigid.small_products import compose, cross, dot, rotate
from rewax.types import Array


def mass_matrix(topology: TreeTopology, parameters: TreeParameters, kin: Kinematics) -> Array:
    """Mass matrix (joint-space inertia), symmetric and positive definite, shape (num_dofs, num_dofs).

    Composite rigid body algorithm (CRBA). Gradient: exact.
    Source: Featherstone 2008, "Rigid Body Dynamics Algorithms", section 6.2, with sums over subtrees for its recursion.
    """
    num_bodies, num_dofs = topology.moves.shape
    mass, arm = parameters.body_mass[:, None], kin.com - kin.tree_com
    turned = skew(arm)
    inertia = _rotational_inertia(parameters, kin) - mass[:, :, None] * compose(turned, turned)
    # Inertia about the tree's center of mass, first moment and mass of the bodies that a degree of freedom moves.
    moments = jnp.concatenate([inertia.reshape(num_bodies, 9), mass * arm, mass], axis=-1)
    carried = dot(topology.subtree[topology.dof_body], moments)
    inertia, moment, mass = carried[:, :9].reshape(num_dofs, 3, 3), carried[:, 9:12], carried[:, 12:]
    angular, linear = kin.axes[:, :3], kin.axes[:, 3:]
    torque = rotate(inertia, angular) + cross(moment, linear)
    force = jnp.concatenate([torque, mass * linear - cross(moment, angular)], axis=-1)
    carries = topology.moves[topology.dof_body] * np.tri(num_dofs, k=-1)  # earlier dofs that move the body of dof i
    lower = dot(force, kin.axes.T) * structural_zeros(jnp.asarray(carries, force.dtype))
    return lower + lower.T + jnp.diag(jnp.sum(force * kin.axes, axis=-1) + parameters.dof_armature)


def inverse_dynamics(
    topology: TreeTopology,
    parameters: TreeParameters,
    kin: Kinematics,
    qvel: Array,
    qacc: Array,
    gravity: Array,
) -> Array:
    """Inverse dynamics (RNEA): generalized forces that cause given accelerations, shape (num_dofs,).

    Args:
      topology, parameters, kin: the tree and its kinematics.
      qvel: joint velocities [m/s, rad/s], shape (num_dofs,).
      qacc: joint accelerations [m/s^2, rad/s^2], shape (num_dofs,). The result is affine in them; its slope is the mass
        matrix.
      gravity: gravitational acceleration [m/s^2], shape (3,).

    Gradient: exact.
    Source: recursive Newton-Euler algorithm (RNEA), Featherstone 2008, table 5.1, with sums over chains for recursions.
    """
    velocity = body_velocities(topology, kin, qvel)
    change = axis_drifts(topology, kin, qvel) + kin.axes * structural_zeros(qacc)[:, None]
    acceleration = dot(topology.moves, change) - jnp.concatenate([jnp.zeros(3, gravity.dtype), gravity])
    inertia = _rotational_inertia(parameters, kin)
    arm, mass = kin.com - kin.tree_com, parameters.body_mass[:, None]

    def momentum(motion: Array) -> Array:
        angular, linear = motion[:, :3], motion[:, 3:]
        p = mass * (linear + cross(angular, arm))
        return jnp.concatenate([rotate(inertia, angular) + cross(arm, p), p], axis=-1)

    wrenches = momentum(acceleration) + _force_cross(velocity, momentum(velocity))
    return generalized_forces(topology, kin, wrenches) + parameters.dof_armature * qacc


def spin_slopes(
    topology: TreeTopology, parameters: TreeParameters, kin: Kinematics, qvel: Array, free_dofs: np.ndarray
) -> Array:
    """Derivative of the bias forces of single free bodies with respect to velocity, shape (num_dofs, num_dofs).

    The gyroscopic torques make it asymmetric.

    Args:
      topology, parameters, kin: the tree and its kinematics.
      qvel: joint velocities [m/s, rad/s], shape (num_dofs,).
      free_dofs: degrees of freedom of free joints that share no tree with another joint, shape (n, 6).

    Gradient: exact.
    """
    num_dofs = len(topology.dof_joint)
    still, weightless = jnp.zeros(num_dofs, qvel.dtype), jnp.zeros(3, qvel.dtype)

    def bias(velocity: Array) -> Array:
        return inverse_dynamics(topology, parameters, kin, velocity, still, weightless)

    # The bodies are independent, so six tangent directions serve all of them at once.
    number, coordinate = np.full(num_dofs, -1), np.full(num_dofs, -1)
    number[free_dofs] = np.arange(len(free_dofs))[:, None]
    coordinate[free_dofs] = np.arange(6)
    moves = jnp.asarray(coordinate == np.arange(6)[:, None], qvel.dtype)
    slopes = jax.vmap(lambda move: jax.jvp(bias, (qvel,), (move,))[1])(moves)
    same = (number[:, None] == number) & (number >= 0)
    return jnp.where(same, slopes.T[:, coordinate], 0.0)


def _rotational_inertia(parameters: TreeParameters, kin: Kinematics) -> Array:
    """Inertia about each body's center of mass, in world axes [kg m^2], shape (num_bodies, 3, 3)."""
    axes = kin.inertia_rotation
    return compose(axes * parameters.body_inertia[:, None, :], jnp.swapaxes(axes, -1, -2))


def _force_cross(a: Array, f: Array) -> Array:
    """Rate of change of spatial forces f = [torque, force] that move with velocity a, shape (n, 6)."""
    w, v = a[:, :3], a[:, 3:]
    return jnp.concatenate([cross(w, f[:, :3]) + cross(v, f[:, 3:]), cross(w, f[:, 3:])], axis=-1)
