"""The velocity-product term of connect equalities, which MJX omits."""

# pyright: reportAttributeAccessIssue=false

import jax.numpy as jnp
import mujoco
import numpy as np

from rewax.physics.rigid import mjcf
from rewax.physics.rigid.kinematic_tree import TreeTopology
from rewax.physics.rigid.kinematics import Kinematics, point_drifts
from rewax.physics.rigid.small_products import rotate, select
from rewax.types import Array


def connect_drifts(
    mj: mujoco.MjModel,
    topology: TreeTopology,
    kin: Kinematics,
    qvel: Array,
    eq_data: Array,
    eq_active: Array,
    site_position: Array | None,
) -> Array:
    """Relative acceleration of the two anchors of each connect equality at constant joint rates [m/s^2].

    MuJoCo 4 subtracts them from the targets of the rows, so that fast-turning bodies stay connected. MJX 3.17 does not.

    Args:
      mj: the model.
      topology, kin: the tree and its kinematics.
      qvel: joint velocities, shape (num_dofs,).
      eq_data, eq_active: data of all equalities and whether each is active, shapes (num_equalities, 11) and
        (num_equalities,).
      site_position: positions of all sites [m], shape (num_sites, 3), or None if there are none.

    Returns:
      One drift per row of the connect equalities, which are the first rows, shape (3 num_connects,).
    """
    connect = np.flatnonzero(mj.eq_type == mujoco.mjtEq.mjEQ_CONNECT)
    if mjcf.is_disabled(mj, "EQUALITY") or mjcf.is_disabled(mj, "CONSTRAINT") or not connect.size:
        return jnp.zeros(0, qvel.dtype)
    of_sites = mj.eq_objtype[connect] == mujoco.mjtObj.mjOBJ_SITE
    between = jnp.zeros((len(connect), 3), qvel.dtype)
    for sign, number, start in ((1.0, mj.eq_obj1id[connect], 0), (-1.0, mj.eq_obj2id[connect], 3)):
        site = np.where(of_sites, number, 0)
        body = np.where(of_sites, mj.site_bodyid[site], number) if mj.nsite else number
        rotation, origin = select(body, kin.rotation), select(body, kin.position)
        point = origin + rotate(rotation, eq_data[connect, start : start + 3])
        if site_position is not None:
            point = jnp.where(of_sites[:, None], site_position[site], point)
        between += sign * point_drifts(topology, kin, qvel, jnp.asarray(body), point)
    return jnp.where(eq_active[connect][:, None], between, 0.0).reshape(-1)


__all__ = ["connect_drifts"]
