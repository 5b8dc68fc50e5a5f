"""The velocity-product term of weld equalities, which MJX omits."""

# pyright: reportAttributeAccessIssue=false

import jax.numpy as jnp
import mujoco
import numpy as np

from rewax.physics.numerics.rotations import quaternion_product
from rewax.physics.rigid import mjcf
from rewax.physics.rigid.kinematic_tree import TreeTopology
from rewax.physics.rigid.kinematics import Kinematics, axis_drifts, body_velocities, point_drifts
from rewax.physics.rigid.small_products import cross, dot, rotate, select
from rewax.types import Array


def weld_drifts(
    mj: mujoco.MjModel,
    topology: TreeTopology,
    kin: Kinematics,
    qvel: Array,
    eq_data: Array,
    eq_active: Array,
    body_quaternion: Array,
    site_quaternion: Array,
    site_position: Array | None,
) -> Array:
    """Accelerations of the errors of weld equalities at constant joint rates.

    MuJoCo 4 subtracts them from the targets of the rows. MJX 3.17 does not.

    Args:
      mj: the model.
      topology, kin: the tree and its kinematics.
      qvel: joint velocities, shape (num_dofs,).
      eq_data, eq_active: data of all equalities and whether each is active, shapes (num_equalities, 11) and
        (num_equalities,).
      body_quaternion: orientations of all bodies as MJX uses them in the rows, shape (num_bodies, 4).
      site_quaternion: orientations of all sites in their bodies' frames, shape (num_sites, 4).
      site_position: positions of all sites [m], shape (num_sites, 3), or None if there are none.

    Returns:
      Six drifts per weld equality, shape (6 num_welds,): three of the gap between two points, three of the vector part
      of the relative quaternion. Their rows follow those of connect equalities.

    Gradient: exact.
    """
    weld = np.flatnonzero(mj.eq_type == mujoco.mjtEq.mjEQ_WELD)
    if mjcf.is_disabled(mj, "EQUALITY") or mjcf.is_disabled(mj, "CONSTRAINT") or not weld.size:
        return jnp.zeros(0, qvel.dtype)
    of_sites = mj.eq_objtype[weld] == mujoco.mjtObj.mjOBJ_SITE
    velocity = body_velocities(topology, kin, qvel)
    acceleration = dot(topology.moves, axis_drifts(topology, kin, qvel))
    gap, turns, quaternions = jnp.zeros((len(weld), 3), qvel.dtype), [], []
    for sign, number, start in ((1.0, mj.eq_obj1id[weld], 3), (-1.0, mj.eq_obj2id[weld], 0)):
        site = np.where(of_sites, number, 0)
        body = np.where(of_sites, mj.site_bodyid[site], number) if mj.nsite else number
        point = select(body, kin.position) + rotate(select(body, kin.rotation), eq_data[weld, start : start + 3])
        quaternion = select(body, body_quaternion)
        if site_position is not None:
            point = jnp.where(of_sites[:, None], site_position[site], point)
            turned = quaternion_product(quaternion, site_quaternion[site])
            quaternion = jnp.where(of_sites[:, None], turned, quaternion)
        gap += sign * point_drifts(topology, kin, qvel, jnp.asarray(body), point)
        turns.append((select(body, velocity)[:, :3], select(body, acceleration)[:, :3]))
        quaternions.append(quaternion)

    # The error is the vector of conj(q2) q1 r; with w = w1 - w2 its rate is half that of conj(q2) w q1 r.
    (spin, change), (other_spin, other_change) = turns
    first, second = quaternions
    placed = quaternion_product(first, eq_data[weld, 6:10])
    placed = jnp.where(of_sites[:, None], first, placed)
    apart = spin - other_spin
    middle = jnp.concatenate(
        [-0.5 * jnp.sum(apart * apart, axis=-1, keepdims=True), change - other_change - cross(other_spin, spin)],
        axis=-1,
    )
    conjugate = second * np.array([1.0, -1.0, -1.0, -1.0])
    turn = quaternion_product(quaternion_product(conjugate, middle), placed)[:, 1:]
    both = jnp.concatenate([gap, 0.5 * eq_data[weld, 10:11] * turn], axis=-1)
    return jnp.where(eq_active[weld][:, None], both, 0.0).reshape(-1)


__all__ = ["weld_drifts"]
