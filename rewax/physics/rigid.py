"""Articulated rigid bodies from MJCF models: load, step, poses, velocities, wrenches.

The only file that imports MJX. MJX reads the model and does collision detection, the rows of the constraints,
actuators and passive forces; kinematics and dynamics (``kinematic_tree``) and the solve (``constraint_solver``) are
ours, with a derivative by the implicit function theorem: the backward pass neither repeats nor differentiates the
solver.

Contact follows one of two laws: MuJoCo's soft constraints, or springs and dampers with regularised Coulomb friction
(``Penalty``), as the simulators have it that first-order reinforcement learning began with.
"""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

import contextlib
import copy
import hashlib
import io
import logging
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics import constraint_solver, kinematic_tree, mjcf
from rewax.physics.colliders import Pose
from rewax.physics.constraint_solver import Rows
from rewax.physics.kinematic_tree import Kinematics, Topology, TreeParameters
from rewax.physics.plane_box import plane_box
from rewax.physics.recompute import recomputed
from rewax.physics.rigid_connect import connect_drifts
from rewax.physics.rigid_penalty import Penalty, contact_wrenches, limit_forces
from rewax.physics.sphere_box import sphere_box
from rewax.status import Status, all_finite, flag
from rewax.types import Array

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    # Without the optional package warp MJX prints two warnings that mean nothing to its JAX implementation.
    _level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    import mujoco
    from mujoco import mjx

    logging.disable(_level)

PARAMETERS = (
    *TreeParameters._fields,
    "jnt_range", "jnt_stiffness", "jnt_solref", "jnt_solimp", "jnt_margin", "qpos_spring",
    "dof_damping", "dof_frictionloss", "dof_invweight0", "body_invweight0",
    "geom_size", "geom_pos", "geom_quat", "geom_friction", "geom_solref", "geom_solimp", "geom_margin",
    "pair_friction", "pair_solref", "pair_solimp", "pair_margin",
    "actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange",
)  # fmt: skip
"""Fields of MuJoCo's model that are leaves of ``RigidModel``; everything else about a model is static."""


class _Model:
    """The static part of a ``RigidModel``: two of the same MJCF are equal.

    Under a penalty law the model's pairs of a sphere and a box are not MJX's, but ours.
    """

    def __init__(self, compiled: mujoco.MjModel, *, penalty: bool) -> None:
        buffer = np.empty(mujoco.mj_sizeModel(compiled), np.uint8)
        mujoco.mj_saveModel(compiled, None, buffer)
        self.key = hashlib.sha256(buffer.tobytes()).hexdigest() + f"{jnp.zeros(()).dtype} {penalty}"
        self.mj = compiled
        self.topology: Topology = kinematic_tree.make_topology(
            compiled.body_parentid, compiled.jnt_bodyid, compiled.jnt_type
        )
        with jax.ensure_compile_time_eval():
            self.mjx = mjx.put_model(compiled, impl="jax")
            self.sphere_boxes = mjcf.sphere_box_pairs(compiled) if penalty else (np.zeros(0, int),) * 3
            self.mjx_pairs = np.setdiff1d(np.arange(compiled.npair), self.sphere_boxes[0])
            if len(self.mjx_pairs) < compiled.npair:
                fields = [name for name in vars(self.mjx) if name.startswith("pair_")]
                kept = {name: getattr(self.mjx, name)[self.mjx_pairs] for name in fields}
                self.mjx = self.mjx.replace(npair=len(self.mjx_pairs), **kept)
            self.data = mjx.make_data(self.mjx, impl="jax")
        self.has_contacts = self.data._impl.ncon + len(self.sphere_boxes[0]) > 0
        self.plane_boxes = _plane_boxes(compiled, self.mjx, self.data)
        self.has_damping = bool(np.any(compiled.dof_damping)) and not mjcf.is_disabled(compiled, "EULERDAMP")
        self.num_bounded = int(self.data._impl.ne + self.data._impl.nf)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Model) and self.key == other.key


@struct.dataclass
class RigidModel(struct.Replaceable):
    """A tree of rigid bodies; build it with ``load``.

    Attributes:
      parameters: MuJoCo's fields named in ``PARAMETERS``, as leaves: differentiate with respect to them, vmap over
        them, change them without compiling again. What MuJoCo derives from them (inverse weights) stays as it is.
      gravity: [m/s^2], shape (3,).
      penalty: the contact law, or None for MuJoCo's soft constraints.
      static: everything else.
    """

    parameters: dict[str, Array]
    gravity: Array
    penalty: Penalty | None
    static: _Model = struct.static_field()

    @property
    def num_positions(self) -> int:
        return self.static.mj.nq

    @property
    def num_dofs(self) -> int:
        return self.static.mj.nv

    @property
    def num_actuators(self) -> int:
        return self.static.mj.nu

    @property
    def num_bodies(self) -> int:
        """The world, body 0, included."""
        return self.static.mj.nbody

    @property
    def dt(self) -> float:
        """Duration of a substep [s]."""
        return float(self.static.mj.opt.timestep)

    @property
    def home(self) -> Array:
        """Positions of the model as written: its first keyframe, or its reference pose, shape (num_positions,)."""
        mj = self.static.mj
        return jnp.asarray(mj.key_qpos[0] if mj.nkey else mj.qpos0, self.parameters["qpos0"].dtype)

    def with_parameters(self, **changes: Array) -> "RigidModel":
        """A copy with other numbers.

        Raises:
          ValueError: there is no such parameter, or its shape differs.
        """
        for name, value in changes.items():
            if name not in self.parameters:
                raise ValueError(f"a rigid model has no parameter {name!r}: known are {', '.join(self.parameters)}")
            if jnp.shape(value) != self.parameters[name].shape:
                raise ValueError(
                    f"{name} has shape {jnp.shape(value)}: give shape {self.parameters[name].shape}, as in the model"
                )
        given = {name: jnp.asarray(value, self.parameters[name].dtype) for name, value in changes.items()}
        return self.replace(parameters={**self.parameters, **given})

    def body(self, name: str) -> int:
        """Number of a body."""
        return _number(self.static.mj, "body", name)

    def geom(self, name: str) -> int:
        """Number of a geom."""
        return _number(self.static.mj, "geom", name)

    def joint(self, name: str) -> tuple[int, int]:
        """Where a joint's coordinates begin in positions and in velocities."""
        joint = _number(self.static.mj, "joint", name)
        return int(self.static.mj.jnt_qposadr[joint]), int(self.static.mj.jnt_dofadr[joint])


@struct.dataclass
class RigidState(struct.Replaceable):
    """A tree of rigid bodies between two substeps.

    Attributes:
      qpos: joint positions [m, rad, unit quaternions (w, x, y, z)], shape (num_positions,).
      qvel: joint velocities [m/s, rad/s], shape (num_dofs,).
      act: activations of actuators that have a state, shape (num_activations,).
      qacc: accelerations of the last substep [m/s^2, rad/s^2], shape (num_dofs,): where the next solve begins. No
        gradient.
    """

    qpos: Array
    qvel: Array
    act: Array
    qacc: Array


def load(source: Any, *, dt: float | None = None, penalty: Penalty | None = None) -> RigidModel:
    """A model from MJCF.

    Args:
      source: path of an MJCF file, its text, a ``mujoco.MjSpec`` or a ``mujoco.MjModel``.
      dt: duration of a substep [s]; None: the model's own timestep.
      penalty: contact by springs and dampers with these numbers; None: MuJoCo's soft constraints. For gradients of use
        give these an impedance that begins at zero (``solimp="0.0001 0.95 0.02"``, and dt of at most 1/240 s): by
        default it jumps to 0.9 on contact, and the derivative of that jump's time is missing from every gradient.

    Raises:
      ValueError: it cannot be read, or uses something that is not supported; the message says what and where.
    """
    compiled = mjcf.compile_model(source)
    if dt is not None:
        if not dt > 0.0:
            raise ValueError(f"dt is {dt}: give the duration of a substep in seconds, above 0")
        compiled = copy.copy(compiled)
        compiled.opt.timestep = dt
    mjcf.check_model(compiled, penalty=penalty is not None)
    try:
        static = _Model(compiled, penalty=penalty is not None)
    except (NotImplementedError, AssertionError) as error:
        raise ValueError(
            f"MJX does not support this model ({error}): remove that, or let such geoms not touch"
        ) from error
    gravity = np.zeros(3) if mjcf.is_disabled(compiled, "GRAVITY") else compiled.opt.gravity
    parameters = {name: jnp.asarray(getattr(compiled, name), jnp.zeros(()).dtype) for name in PARAMETERS}
    return RigidModel(
        parameters=parameters,
        gravity=jnp.asarray(gravity, jnp.zeros(()).dtype),
        penalty=penalty if penalty is None else jax.tree.map(jnp.asarray, penalty),
        static=static,
    )


def initial_state(
    model: RigidModel, qpos: Array | np.ndarray | None = None, qvel: Array | np.ndarray | None = None
) -> RigidState:
    """A state in given positions and velocities, by default the model's home, at rest.

    Raises:
      ValueError: a shape does not fit, or a number is not finite.
    """
    qpos = model.home if qpos is None else jnp.asarray(qpos)
    qvel = jnp.zeros(model.num_dofs, qpos.dtype) if qvel is None else jnp.asarray(qvel)
    for name, value, size in (("qpos", qpos, model.num_positions), ("qvel", qvel, model.num_dofs)):
        _check_shape(name, value, (size,))
        if not isinstance(value, jax.core.Tracer) and not bool(jnp.all(jnp.isfinite(value))):
            raise ValueError(f"{name} holds a number that is not finite ({value}): give a finite start")
    act = jnp.zeros(model.static.mj.na, qpos.dtype)
    return RigidState(qpos=qpos, qvel=qvel, act=act, qacc=jnp.zeros(model.num_dofs, qpos.dtype))


def step(
    model: RigidModel,
    state: RigidState,
    ctrl: Array | None = None,
    *,
    wrenches: Array | None = None,
    num_substeps: int = 1,
) -> RigidState:
    """The state ``num_substeps`` substeps of ``model.dt`` later (semi-implicit Euler, MuJoCo's).

    Args:
      model: bodies, actuators, contact law.
      state: before.
      ctrl: controls, held meanwhile, shape (num_actuators,); None: zero.
      wrenches: force [N] and torque [N m] at each body's centre of mass, world axes, held meanwhile, shape
        (num_bodies, 6); None: none.
      num_substeps: at least 1.

    Gradient: exact for the discrete map, forward and reverse, with respect to state, controls, wrenches and parameters;
      the backward pass keeps a state per substep. Zero through ``qacc`` and saturated controls.

    Raises:
      ValueError: a shape does not fit.
    """
    dtype = state.qpos.dtype
    ctrl = jnp.zeros(model.num_actuators, dtype) if ctrl is None else jnp.asarray(ctrl, dtype)
    wrenches = jnp.zeros((model.num_bodies, 6), dtype) if wrenches is None else jnp.asarray(wrenches, dtype)
    _check_shape("ctrl", ctrl, (model.num_actuators,), " (one number per actuator of the model)")
    _check_shape("wrenches", wrenches, (model.num_bodies, 6), " (force and torque per body, the world included)")
    if num_substeps < 1:
        raise ValueError(f"num_substeps is {num_substeps}: give at least 1")

    def substep(state: RigidState, _: None) -> tuple[RigidState, None]:
        return _substep(model, state, ctrl, wrenches)[0], None

    return jax.lax.scan(substep, state, None, length=num_substeps)[0]


def body_poses(model: RigidModel, state: RigidState) -> Pose:
    """Origin and orientation of every body's frame, shapes (num_bodies, 3) and (num_bodies, 3, 3). Gradient: exact."""
    kin = _kinematics(model, state.qpos)
    return Pose(kin.position, kin.rotation)


def geom_poses(model: RigidModel, state: RigidState) -> Pose:
    """Centre and orientation of every geom, shapes (num_geoms, 3) and (num_geoms, 3, 3). Gradient: exact."""
    kin = _kinematics(model, state.qpos)
    return _attached(kin, model.static.mj.geom_bodyid, model.parameters["geom_pos"], model.parameters["geom_quat"])


def body_velocities(model: RigidModel, state: RigidState) -> tuple[Array, Array]:
    """Velocity of each body's origin [m/s] and its angular velocity [rad/s], world axes, shape (num_bodies, 3) each.

    Gradient: exact.
    """
    kin = _kinematics(model, state.qpos)
    twist = kinematic_tree.body_velocities(model.static.topology, kin, state.qvel)
    return kinematic_tree.point_velocities(kin, twist, jnp.arange(model.num_bodies), kin.position), twist[:, :3]


def centers_of_mass(model: RigidModel, state: RigidState) -> Array:
    """Of each body together with all that hangs on it [m], shape (num_bodies, 3); row 0: of everything."""
    return _kinematics(model, state.qpos).subtree_com


def shapes(model: RigidModel, state: RigidState) -> list[dict[str, Any]]:
    """Geoms for pictures: kind, centre [m], and radius, half_length and direction, or rotation and half_sizes [m].

    Kinds are plane, sphere, capsule, cylinder and box; others are left out.
    """
    mj, pose = model.static.mj, geom_poses(model, state)
    found = []
    for geom in range(mj.ngeom):
        kind = mujoco.mjtGeom(mj.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
        size, rotation = model.parameters["geom_size"][geom], pose.rotation[geom]
        shape = {"kind": kind, "centre": pose.position[geom]}
        if kind == "plane":
            found.append({**shape, "direction": rotation[:, 2]})
        elif kind == "sphere":
            found.append({**shape, "radius": size[0]})
        elif kind in ("capsule", "cylinder"):
            found.append({**shape, "radius": size[0], "half_length": size[1], "direction": rotation[:, 2]})
        elif kind == "box":
            found.append({**shape, "rotation": rotation, "half_sizes": size})
    return found


def contact_distances(model: RigidModel, state: RigidState) -> Array:
    """Signed distance of every pair that may touch [m], negative inside, shape (num_contacts,); 1 for unused slots."""
    m, d = _mjx(model, _kinematics(model, state.qpos), state, jnp.zeros(model.num_actuators, state.qpos.dtype))
    return _contacts(model, m, d).distance


def check_status(state: RigidState) -> Array:
    """Bits of ``Status``, shape (), int32: NAN where a number is not finite."""
    return flag(~all_finite((state.qpos, state.qvel)), Status.NAN)


# --- One substep ------------------------------------------------------------------------------------------------------


def _kinematics(model: RigidModel, qpos: Array) -> Kinematics:
    return kinematic_tree.kinematics(model.static.topology, _tree_parameters(model), qpos)


def _tree_parameters(model: RigidModel) -> TreeParameters:
    return TreeParameters(**{name: model.parameters[name] for name in TreeParameters._fields})


def _attached(kin: Kinematics, body: np.ndarray, position: Array, quaternion: Array) -> Pose:
    """World poses of what is fixed to bodies."""
    frames = jnp.concatenate([kin.rotation, kin.position[:, :, None]], axis=-1)
    frame = kinematic_tree.select(body, frames)
    rotation = kinematic_tree.compose(frame[:, :, :3], kinematic_tree.quaternion_to_matrix(quaternion))
    return Pose(frame[:, :, 3] + kinematic_tree.rotate(frame[:, :, :3], position), rotation)


def _mjx(model: RigidModel, kin: Kinematics, state: RigidState, ctrl: Array) -> tuple[mjx.Model, mjx.Data]:
    """MJX's model and data at a state, with all that its collision, constraints, actuators and passive forces read."""
    static, parameters = model.static, dict(model.parameters)
    for name in ("jnt_solimp", "geom_solimp", "pair_solimp"):
        # The exponent of the impedance has a derivative with log(0) in it; the rest may be differentiated.
        value = parameters[name]
        parameters[name] = jnp.concatenate([value[:, :4], jax.lax.stop_gradient(value[:, 4:])], axis=1)
    if len(static.mjx_pairs) < static.mj.npair:
        parameters.update((name, parameters[name][static.mjx_pairs]) for name in parameters if name.startswith("pair_"))
    m = static.mjx.replace(**parameters, opt=static.mjx.opt.replace(gravity=model.gravity))
    d = static.data.replace(
        qpos=state.qpos,
        qvel=state.qvel,
        act=state.act,
        ctrl=ctrl,
        xpos=kin.position,
        xmat=kin.rotation,
        xipos=kin.com,
        ximat=kin.inertia_rotation,
        subtree_com=kin.subtree_com,
        cdof=kin.axes,
    )
    if static.mj.ngeom:
        pose = _attached(kin, static.mj.geom_bodyid, parameters["geom_pos"], parameters["geom_quat"])
        d = d.replace(geom_xpos=pose.position, geom_xmat=pose.rotation)
    if static.mj.nsite:
        pose = _attached(kin, static.mj.site_bodyid, m.site_pos, m.site_quat)
        d = d.replace(site_xpos=pose.position, site_xmat=pose.rotation)
    return m, d


def _applied_forces(
    model: RigidModel, kin: Kinematics, m: mjx.Model, d: mjx.Data, wrenches: Array
) -> tuple[Array, Array]:
    """Generalized forces of actuators, springs, dampers and wrenches, shape (num_dofs,); rates of the activations."""
    topology = model.static.topology
    twist = kinematic_tree.body_velocities(topology, kin, d.qvel)
    d = d.replace(cvel=twist)
    if model.static.mj.ntendon:
        d = mjx.tendon(m, d)
    d = mjx.transmission(m, d)
    d = d.tree_replace(  # pyright: ignore[reportAssignmentType]
        {
            "_impl.actuator_velocity": d._impl.actuator_moment @ d.qvel,
            "_impl.ten_velocity": d._impl.ten_J @ d.qvel,
        }
    )
    d = mjx.fwd_actuation(m, mjx.passive(m, d))
    arm = kin.com - kin.tree_com
    torque = wrenches[:, 3:] + kinematic_tree.cross(arm, wrenches[:, :3])
    external = jnp.concatenate([torque, wrenches[:, :3]], axis=-1)
    if model.penalty is not None:
        external = external + _contact_wrenches(model, model.penalty, kin, m, d, twist)
    force = d.qfrc_passive + d.qfrc_actuator + kinematic_tree.generalized_forces(topology, kin, external)
    if model.penalty is not None:
        mj = model.static.mj
        joint = np.flatnonzero(mj.jnt_limited)
        position, dof = mj.jnt_qposadr[joint], mj.jnt_dofadr[joint]
        limits = model.parameters["jnt_range"][joint] + model.parameters["jnt_margin"][joint, None] * np.array([1, -1])
        force = force.at[dof].add(limit_forces(model.penalty, limits, d.qpos[position], d.qvel[dof]))
    return force, d.act_dot


def _collide(model: RigidModel, m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """Contacts of all pairs."""
    d = mjx.collision(m, d)
    slots, plane, box = model.static.plane_boxes
    if len(slots) == 0:
        return d
    distance, point = jax.vmap(plane_box)(
        d.geom_xpos[plane], d.geom_xmat[plane][:, :, 2], d.geom_xpos[box], d.geom_xmat[box], m.geom_size[box]
    )
    contact = d._impl.contact
    contact = contact.replace(
        dist=contact.dist.at[slots].set(distance.reshape(-1)),
        pos=contact.pos.at[slots].set(point.reshape(-1, 3)),
    )
    return d.tree_replace({"_impl.contact": contact})  # pyright: ignore[reportReturnType, reportArgumentType]


def _plane_boxes(compiled: mujoco.MjModel, m: mjx.Model, d: mjx.Data) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slots of the contacts of boxes with planes, four for each, and planes and boxes of these."""
    limited = any(
        compiled.numeric(i).name in ("max_contact_points", "max_geom_pairs") for i in range(compiled.nnumeric)
    )
    both = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX)
    if d._impl.ncon == 0 or limited or not np.isin(both, compiled.geom_type).all():
        none = np.zeros(0, int)
        return none, none, none
    # Constants of the program: of the collisions nothing is left to compile.
    geoms = np.asarray(jax.jit(lambda: mjx.collision(m, d)._impl.contact.geom).lower().compile()())
    slots = np.flatnonzero((compiled.geom_type[geoms] == both).all(axis=1))
    return slots, geoms[slots[::4], 0], geoms[slots[::4], 1]


class _Contacts(NamedTuple):
    """What the penalty law needs to know of all pairs that may touch, see ``rigid_penalty.contact_wrenches``."""

    distance: Array
    margin: Array
    point: Array
    normal: Array
    friction: Array
    geoms: Array


def _contacts(model: RigidModel, m: mjx.Model, d: mjx.Data) -> _Contacts:
    """Those that MJX finds, then those of spheres with boxes that are ours."""
    contact = _collide(model, m, d)._impl.contact
    friction = jnp.where(np.asarray(contact.dim) > 1, contact.friction[:, 0], 0.0)
    found = _Contacts(
        contact.dist, contact.includemargin, contact.pos, contact.frame[:, 0], friction, jnp.asarray(contact.geom)
    )
    mj, (own, sphere, box) = model.static.mj, model.static.sphere_boxes
    if len(own) == 0:
        return found
    size, xpos = m.geom_size, d.geom_xpos
    distance, point, normal = sphere_box(xpos[sphere], size[sphere, 0], xpos[box], d.geom_xmat[box], size[box])
    margin, friction = (model.parameters[f"pair_{name}"][own] for name in ("margin", "friction"))
    friction = jnp.where(mj.pair_dim[own] > 1, friction[:, 0], 0.0)
    ours = _Contacts(distance, margin, point, normal, friction, jnp.asarray(np.stack([sphere, box], axis=1)))
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), found, ours)


def _contact_wrenches(
    model: RigidModel, penalty: Penalty, kin: Kinematics, m: mjx.Model, d: mjx.Data, twist: Array
) -> Array:
    """Wrenches of all contacts on all bodies under the penalty law, shape (num_bodies, 6)."""
    if not model.static.has_contacts:
        return jnp.zeros_like(twist)
    found = _contacts(model, m, d)
    return contact_wrenches(
        penalty,
        kin,
        twist,
        distance=found.distance - found.margin,
        point=found.point,
        normal=found.normal,
        friction=found.friction,
        bodies=jnp.asarray(model.static.mj.geom_bodyid)[found.geoms],
    )


def _rows(model: RigidModel, kin: Kinematics, m: mjx.Model, d: mjx.Data) -> Rows:
    """Constraints of limits, contacts, dry friction and equalities; none under the penalty law."""
    if model.penalty is None:
        if model.static.has_contacts:
            d = _collide(model, m, d)
        if model.static.mj.ntendon:
            d = mjx.tendon(m, d)
        d = mjx.make_constraint(m, d)
        impl = d._impl
        loss, infinite = impl.efc_frictionloss, jnp.full_like(impl.efc_D, jnp.inf)
        index = np.arange(len(loss))
        equality, dry = index < impl.ne, (index >= impl.ne) & (index < impl.ne + impl.nf)
        lower = jnp.where(equality, -infinite, jnp.where(dry, -loss, 0.0))
        upper = jnp.where(dry, loss, infinite)
        sites = d.site_xpos if model.static.mj.nsite else None
        drifts = connect_drifts(model.static.mj, model.static.topology, kin, d.qvel, m.eq_data, d.eq_active, sites)
        target = impl.efc_aref.at[: len(drifts)].add(-drifts)
        return Rows(impl.efc_J, impl.efc_D, target, lower, upper)
    none = jnp.zeros(0, d.qpos.dtype)
    return Rows(jnp.zeros((0, model.num_dofs), d.qpos.dtype), none, none, none, none)


def _accelerate(model: RigidModel, state: RigidState, ctrl: Array, wrenches: Array) -> tuple[RigidState, Array]:
    """One substep; the state after it, and the acceleration that its velocity changed with, shape (num_dofs,)."""
    with jax.default_matmul_precision("highest"):
        topology, parameters = model.static.topology, _tree_parameters(model)
        kin = _kinematics(model, state.qpos)
        m, d = _mjx(model, kin, state, ctrl)
        applied, act_dot = _applied_forces(model, kin, m, d, wrenches)
        rows = _rows(model, kin, m, d)
        still = jnp.zeros_like(state.qvel)
        force = applied - kinematic_tree.inverse_dynamics(topology, parameters, kin, state.qvel, still, model.gravity)
        mass = kinematic_tree.mass_matrix(topology, parameters, kin)
        qacc = constraint_solver.solve_accelerations(
            mass,
            force,
            rows,
            state.qacc,
            max_iterations=model.static.mj.opt.iterations,
            num_bounded=model.static.num_bounded,
        )
        rate = qacc
        if model.static.has_damping:
            total = force + rows.jacobian.T @ constraint_solver.row_forces(rows, qacc)
            rate = constraint_solver.solve_spd(_damped(model, mass), total)
        return _advance(model, state, act_dot, qacc, rate), rate


def _acceleration_derivative(
    known: tuple[RigidState, Array], model: RigidModel, state: RigidState, ctrl: Array, wrenches: Array
) -> tuple[RigidState, Array]:
    """What ``_accelerate`` returned, with its derivative: all forces balance at the accelerations found."""
    with jax.default_matmul_precision("highest"):
        topology, parameters = model.static.topology, _tree_parameters(model)
        qacc, rate = jax.lax.stop_gradient((known[0].qacc, known[1]))
        kin = _kinematics(model, state.qpos)
        m, d = _mjx(model, kin, state, ctrl)
        applied, act_dot = _applied_forces(model, kin, m, d, wrenches)
        rows = _rows(model, kin, m, d)
        mass = kinematic_tree.mass_matrix(topology, *jax.lax.stop_gradient((parameters, kin)))

        def unbalanced(acceleration: Array, forces: Array) -> Array:
            needed = kinematic_tree.inverse_dynamics(topology, parameters, kin, state.qvel, acceleration, model.gravity)
            return needed - applied - rows.jacobian.T @ forces

        matrix = constraint_solver.curvature(mass, jax.lax.stop_gradient(rows), qacc)
        residual = unbalanced(qacc, constraint_solver.row_forces(rows, qacc))
        solved = qacc - constraint_solver.implicit_correction(matrix, residual)
        if model.static.has_damping:
            residual = unbalanced(rate, constraint_solver.row_forces(rows, solved))
            residual = residual + model.dt * model.parameters["dof_damping"] * rate
            solved = rate - constraint_solver.implicit_correction(_damped(model, mass), residual)
        return _advance(model, state, act_dot, qacc, solved), solved


_substep = recomputed(_accelerate, surrogate=_acceleration_derivative)


def _damped(model: RigidModel, mass: Array) -> Array:
    """The matrix of MuJoCo's Euler step, implicit in the joints' damping."""
    return mass + jnp.diag(model.dt * model.parameters["dof_damping"])


def _advance(model: RigidModel, state: RigidState, act_dot: Array, qacc: Array, rate: Array) -> RigidState:
    qvel = state.qvel + model.dt * rate
    return RigidState(
        qpos=kinematic_tree.integrate(model.static.topology, state.qpos, qvel, model.dt),
        qvel=qvel,
        act=_next_activations(model, state.act, act_dot),
        qacc=jax.lax.stop_gradient(qacc),
    )


def _next_activations(model: RigidModel, act: Array, act_dot: Array) -> Array:
    mj = model.static.mj
    if not mj.na:
        return act
    actuator = np.repeat(np.arange(mj.nu), np.maximum(mj.actuator_actnum, 0))
    exact = mj.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_FILTEREXACT
    tau = np.maximum(mj.actuator_dynprm[actuator, 0], mujoco.mjMINVAL)
    span = np.where(exact, tau * -np.expm1(-mj.opt.timestep / tau), mj.opt.timestep)
    limited = mj.actuator_actlimited[actuator].astype(bool)
    low, high = (np.where(limited, mj.actuator_actrange[actuator, i], (-np.inf, np.inf)[i]) for i in (0, 1))
    return jnp.clip(act + jnp.asarray(span, act.dtype) * act_dot, low, high).astype(act.dtype)


# --- Arguments --------------------------------------------------------------------------------------------------------


def _check_shape(name: str, value: Array, shape: tuple[int, ...], what: str = "") -> None:
    if jnp.shape(value) != shape:
        raise ValueError(f"{name} has shape {jnp.shape(value)}: give shape {shape}{what}")


def _number(mj: mujoco.MjModel, kind: str, name: str) -> int:
    number = mujoco.mj_name2id(mj, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if number < 0:
        count = {"body": mj.nbody, "geom": mj.ngeom, "joint": mj.njnt}[kind]
        known = [mujoco.mj_id2name(mj, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), i) for i in range(count)]
        raise ValueError(f"the model has no {kind} {name!r}: known are {', '.join(n for n in known if n)}")
    return number
