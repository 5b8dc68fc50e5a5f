"""Articulated rigid bodies: a model loaded from MJCF, its parameters, its state.

MuJoCo compiles the model. MJX supplies the static data of constraints and contacts (``mjx_access`` imports it).
"""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

import copy
import hashlib
from collections.abc import Sequence
from typing import Any, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics.numerics.arguments import check_instance, check_plain, real_array
from rewax.physics.numerics.checks import FINITE, POSITIVE, Number, check_numbers, static_number
from rewax.physics.rigid import mjcf
from rewax.physics.rigid.collide import collisions
from rewax.physics.rigid.contact_pair import ContactPair, check_contact_pairs
from rewax.physics.rigid.kinematic_tree import TreeParameters, TreeTopology, tree_topology
from rewax.physics.rigid.mjx_access import mjx, mujoco, num_bounded_rows
from rewax.physics.rigid.overrides import Overrides, check_options, moving_geoms, with_overrides, without_idle_parts
from rewax.physics.rigid.parameter_checks import check_compiled, check_unit_lengths, parameter_numbers, size_numbers
from rewax.physics.rigid.shown_to_mjx import with_groups_that_touch, without_contacts
from rewax.physics.rigid.spring_contacts import Penalty, check_penalty
from rewax.types import Array

PARAMETERS = (
    *TreeParameters._fields,
    "jnt_range", "jnt_stiffness", "jnt_solref", "jnt_solimp", "jnt_margin", "qpos_spring",
    "dof_damping", "dof_frictionloss", "dof_invweight0", "body_invweight0",
    "geom_size", "geom_pos", "geom_quat", "geom_friction", "geom_solref", "geom_solimp", "geom_margin",
    "pair_friction", "pair_solref", "pair_solimp", "pair_margin",
    "actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange",
)  # fmt: skip
"""Fields of MuJoCo's model that are parameters of a ``RigidModel``. All other fields are static."""


class _Model:
    """The static part of a ``RigidModel``. Two of them are equal if their MJCF and contact pairs are equal.

    Under a penalty law, explicit sphere-box and capsule-capsule pairs have functions of their own; with
    ``boxes_touch_once`` box-box pairs have one too. A contact pair that the user added for these kinds comes first.
    """

    def __init__(
        self, compiled: mujoco.MjModel, penalty: Penalty | None, contact_pairs: tuple[ContactPair, ...] = ()
    ) -> None:
        buffer = np.empty(mujoco.mj_sizeModel(compiled), np.uint8)
        mujoco.mj_saveModel(compiled, None, buffer)
        law = (penalty is not None, penalty is not None and penalty.boxes_touch_once)
        self.key = hashlib.sha256(buffer.tobytes()).hexdigest() + f"{jnp.zeros(()).dtype} {law}"
        self.contact_pairs = contact_pairs
        self.mj = compiled
        self.topology: TreeTopology = tree_topology(compiled.body_parentid, compiled.jnt_bodyid, compiled.jnt_type)
        none, added = np.zeros(0, int), {pair.kinds for pair in contact_pairs}

        def apart(kinds: tuple[str, str], wanted: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            return mjcf.own_pairs(compiled, *kinds) if wanted and kinds not in added else (none, none, none)

        self.sphere_boxes = apart(("sphere", "box"), law[0])
        self.capsules = apart(("capsule", "capsule"), law[0])
        self.boxes = apart(("box", "box"), law[1])
        own = np.concatenate([self.sphere_boxes[0], self.capsules[0], self.boxes[0]])
        others = np.setdiff1d(np.arange(compiled.npair), own)
        self.collisions = collisions(compiled, others, penalty=law[0], added=contact_pairs)
        shown = without_idle_parts(compiled)
        if any(group.kinds in added for group in self.collisions.groups):
            shown = with_groups_that_touch(shown, self.collisions.mjx_groups)
        with jax.ensure_compile_time_eval():
            self.mjx = without_contacts(shown, mjx.put_model(shown, jax.local_devices()[0], impl="jax"))
            self.data = mjx.make_data(self.mjx, jax.local_devices()[0], impl="jax")
        self.has_contacts = len(self.collisions.groups) + len(own) > 0
        on_field = [group.geoms[:, 1] for group in self.collisions.groups if group.kinds[0] == "hfield"]
        self.on_field = np.unique(np.concatenate([none, *on_field]))
        self.moving_geoms = moving_geoms(compiled)
        self.is_implicit = compiled.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.lone_dofs = mjcf.lone_dofs(compiled) if self.is_implicit else np.zeros((0, 6), int)
        self.has_damping = self.is_implicit or (
            bool(np.any(compiled.dof_damping)) and not mjcf.is_disabled(compiled, "EULERDAMP")
        )
        self.has_welds = bool(np.any(compiled.eq_type == mujoco.mjtEq.mjEQ_WELD))
        self.num_bounded = sum(num_bounded_rows(self.data))

    def __hash__(self) -> int:
        return hash((self.key, self.contact_pairs))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Model) and (self.key, self.contact_pairs) == (other.key, other.contact_pairs)


@struct.dataclass
class RigidModel(struct.Replaceable):
    """A tree of rigid bodies; build it with ``load``.

    Attributes:
      parameters: MuJoCo's fields named in ``PARAMETERS``. Differentiate with respect to them, vmap over them, change
        them without compiling again. Values that MuJoCo derives from them do not follow: inverse weights, the strength
        of muscles without a ``force``, lengths of tendons at rest, and damping given as ``dampratio``. Ranges of
        unlimited joints and actuators have no effect. Traced dry friction of a joint that was loaded without it has no
        effect; in a model loaded without damping, a traced one is explicit in time. Limits whose two margins overlap
        have one constraint instead of two. Mass and inertia are separate parameters: change both. Quaternions and axes
        must keep length 1. Sizes of meshes and height fields have no effect. Geoms on a height field must not grow, or
        ``check_status`` sets ``Status.INVALID_PARAMETERS``. The exponent of an impedance (the last entry of solimp) has
        no gradient.
      gravity: gravitational acceleration [m/s^2], shape (3,).
      penalty: the contact law, or None for MuJoCo's soft constraints.
      static: the static part of the model.
    """

    parameters: dict[str, Array]
    gravity: Array
    penalty: Penalty | None
    static: _Model = struct.static_field()

    @property
    def num_positions(self) -> int:
        """Length of ``qpos``: MuJoCo's ``nq``."""
        return self.static.mj.nq

    @property
    def num_dofs(self) -> int:
        """Length of ``qvel``: MuJoCo's ``nv``."""
        return self.static.mj.nv

    @property
    def num_actuators(self) -> int:
        """Length of ``ctrl``: MuJoCo's ``nu``."""
        return self.static.mj.nu

    @property
    def num_bodies(self) -> int:
        """Number of bodies, including the world, body 0."""
        return self.static.mj.nbody

    @property
    def dt(self) -> float:
        """Duration of a substep [s]."""
        return float(self.static.mj.opt.timestep)

    @property
    def home(self) -> Array:
        """Joint positions [m, rad] of the first keyframe, else of the reference pose, shape (num_positions,)."""
        mj = self.static.mj
        return jnp.asarray(mj.key_qpos[0] if mj.nkey else mj.qpos0, self.parameters["qpos0"].dtype)

    def with_parameters(self, **changes: Array) -> "RigidModel":
        """A copy with other parameters.

        Raises:
          ValueError: there is no such parameter, its shape differs, a value is illegal (not finite; a mass, size or
            friction below 0; a range whose lower limit is the larger one), the model was loaded without the damping or
            dry friction to change, or a size cannot change.

        Gradient: exact.
        """
        for name, value in changes.items():
            if name not in self.parameters:
                raise ValueError(f"a rigid model has no parameter {name!r}: known are {', '.join(self.parameters)}")
            real_array(name, value, "give an array of numbers in MuJoCo's unit")
            if np.shape(value) != self.parameters[name].shape:
                raise ValueError(
                    f"{name} has shape {np.shape(value)}: give shape {self.parameters[name].shape}, as in the model"
                )
            if name in ("dof_damping", "dof_frictionloss") and not isinstance(value, jax.core.Tracer):
                self._check_loaded(name, np.asarray(value))
            if name == "geom_size":
                self._check_sizes(value)
            if name == "actuator_gear" and not isinstance(value, jax.core.Tracer):
                mjcf.check_gear(self.static.mj, np.asarray(value))
        check_numbers(parameter_numbers(changes))
        check_unit_lengths(changes)
        given = {name: jnp.asarray(value, self.parameters[name].dtype) for name, value in changes.items()}
        return self.replace(parameters={**self.parameters, **given})

    def _check_loaded(self, name: str, value: np.ndarray) -> None:
        """Raises ValueError for damping in a model, or dry friction in a joint, that was loaded without it."""
        mj = self.static.mj
        loaded = np.asarray(getattr(mj, name)) > 0
        if name == "dof_damping":  # one implicit solve serves all joints
            loaded = np.full_like(loaded, loaded.any())
        wrong = ~loaded & (value != 0)
        if np.any(wrong):
            joint = mjcf.named(mj, "joint", np.isin(np.arange(mj.njnt), mj.dof_jntid[wrong]))
            raise ValueError(
                f"{joint} was loaded without {name}, so it cannot change: give it a positive value in the MJCF"
            )

    def _check_sizes(self, size: Any) -> None:
        """Raises ValueError for a geom on a height field that grows, and a mesh or height field of another size."""
        mj = self.static.mj
        check_numbers(size_numbers(mj, size if isinstance(size, jax.Array) else np.asarray(size), self.static.on_field))
        if isinstance(size, jax.core.Tracer):
            return
        kinds = mujoco.mjtGeom
        fixed = np.isin(mj.geom_type, [int(kinds.mjGEOM_MESH), int(kinds.mjGEOM_HFIELD), int(kinds.mjGEOM_SDF)])
        wrong = fixed & ~np.isclose(np.asarray(size), mj.geom_size, rtol=1e-4, atol=1e-9).all(axis=1)
        if np.any(wrong):
            raise ValueError(
                f"{mjcf.named(mj, 'geom', wrong)} is a mesh or a height field, whose geom_size has no effect: scale it "
                "in the MJCF"
            )

    def with_mocap(self, position: Array, quaternion: Array | None = None) -> "RigidModel":
        """A copy with other poses of the mocap bodies. One compiled step serves all such copies.

        Mocap bodies jump between steps. Contacts and equalities see them at rest, as in MuJoCo.

        Args:
          position: positions of the mocap bodies, in the order of the model [m], shape (num_mocap, 3).
          quaternion: orientations (w, x, y, z) of any length above 0, shape (num_mocap, 4); None: unchanged.

        Raises:
          ValueError: a shape differs, a value is not finite, a quaternion has length 0, or the model has no mocap
            bodies.

        Gradient: exact with respect to both arguments.
        """
        bodies = np.flatnonzero(self.static.mj.body_mocapid >= 0)
        if not len(bodies):
            raise ValueError('the model has no mocap bodies: give one of the world\'s bodies mocap="true" in its MJCF')
        numbers = self.static.mj.body_mocapid[bodies]
        rows = "give one row per mocap body"
        changes = {"body_pos": jnp.asarray(real_array("position", position, rows), self.home.dtype)}
        check_shape("position", changes["body_pos"], (len(bodies), 3), " (one row per mocap body)")
        check_numbers([Number("position", changes["body_pos"], FINITE, "give a position in metres")])
        if quaternion is not None:
            q = jnp.asarray(real_array("quaternion", quaternion, rows), self.home.dtype)
            check_shape("quaternion", q, (len(bodies), 4), " (one row per mocap body)")
            check_numbers(
                [Number("the quaternion's squared length", jnp.sum(q * q, axis=-1), POSITIVE, "give (w, x, y, z)")]
            )
            changes["body_quat"] = q / jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True))
        moved = {name: self.parameters[name].at[bodies].set(value[numbers]) for name, value in changes.items()}
        return self.replace(parameters={**self.parameters, **moved})

    def body(self, name: str) -> int:
        """Id of the body with this name. Raises ValueError, with the known names, if there is none."""
        return mjcf.number(self.static.mj, "body", name)

    def geom(self, name: str) -> int:
        """Id of the geom with this name. Raises ValueError, with the known names, if there is none."""
        return mjcf.number(self.static.mj, "geom", name)

    def joint(self, name: str) -> tuple[int, int]:
        """Offsets of a joint's coordinates in qpos and in qvel. Raises ValueError, with the known names, if there is
        no such joint."""
        joint = mjcf.number(self.static.mj, "joint", name)
        return int(self.static.mj.jnt_qposadr[joint]), int(self.static.mj.jnt_dofadr[joint])


@struct.dataclass
class RigidState(struct.Replaceable):
    """State of a tree of rigid bodies.

    Attributes:
      qpos: joint positions [m, rad, unit quaternions (w, x, y, z)], shape (num_positions,).
      qvel: joint velocities [m/s, rad/s], shape (num_dofs,).
      act: activations of stateful actuators, shape (num_activations,).
      qacc: accelerations of the last substep [m/s^2, rad/s^2], shape (num_dofs,): the first guess of the next solve. No
        gradient.
      unsolved: 1.0 if in a substep of the last step the constraint solver reached its limit of iterations before the
        forces balanced, else 0.0, shape (). No gradient.
    """

    qpos: Array
    qvel: Array
    act: Array
    qacc: Array
    unsolved: Array


def load(
    source: Any,
    *,
    dt: float | None = None,
    penalty: Penalty | None = None,
    contact_pairs: Sequence[ContactPair] = (),
    **overrides: Unpack[Overrides],
) -> RigidModel:
    """Loads a model from MJCF, without the parts that do not affect the motion: energy, sensors, visual geoms.

    Args:
      source: path of an MJCF file, its text, a ``mujoco.MjSpec`` or a ``mujoco.MjModel``.
      dt: duration of a substep [s]; None: the model's own timestep.
      penalty: parameters of a contact law of springs and dampers; None: MuJoCo's soft constraints. Useful gradients of
        the latter need an impedance that begins near zero (``solimp="0.0001 0.95 0.02"``, and dt of at most 1/240 s):
        the default jumps to 0.9 on contact, and gradients lack the derivative of the time of this jump.
      contact_pairs: contact functions of kinds of geoms. They are added to the built-in ones
        (``built_in_pairs.BUILT_IN_PAIRS``) or replace them. MJX collides all other kinds.
      **overrides: options that replace the model's own, such as ``integrator="Euler"`` and ``cone="pyramidal"`` if its
        own are not supported; ``overrides.Overrides`` lists them.

    Raises:
      ValueError: the model cannot be read or has an unsupported feature; the message names it and an override that
        helps. An override is unknown or has an illegal value. dt is not positive. The penalty law has an illegal
        number, or is unstable at this dt. A contact pair is not as ``ContactPair`` requires, or two have the same
        kinds.

    Example:
      >>> model = rigid.load("humanoid.xml", integrator="implicitfast", cone="pyramidal")  # doctest: +SKIP
    """
    if isinstance(contact_pairs, ContactPair):
        raise ValueError(f"contact_pairs is {contact_pairs}: give a sequence, contact_pairs=(pair,) for one")
    check_instance("contact_pairs", contact_pairs, (tuple, list), "give a sequence, contact_pairs=(pair,) for one")
    contact_pairs = tuple(contact_pairs)
    check_contact_pairs(contact_pairs)
    compiled = with_overrides(mjcf.compile_model(source), overrides)
    if dt is not None:
        remedy = "give the duration of a substep in seconds"
        check_plain("dt", dt, remedy)
        compiled = copy.copy(compiled)
        compiled.opt.timestep = static_number("dt", dt, POSITIVE, remedy)
    check_options(compiled)
    check_compiled(compiled)
    mjcf.check_model(compiled, penalty=penalty is not None)
    parameters = {name: np.array(getattr(compiled, name)) for name in PARAMETERS}
    if compiled.nkey and compiled.nmocap:
        mocap = compiled.body_mocapid >= 0
        for name, keyed in (("body_pos", compiled.key_mpos[0]), ("body_quat", compiled.key_mquat[0])):
            parameters[name][mocap] = keyed.reshape(compiled.nmocap, -1)[compiled.body_mocapid[mocap]]
    check_numbers(parameter_numbers(parameters))
    check_unit_lengths(parameters)
    if penalty is not None:
        check_penalty(penalty, float(np.max(compiled.body_subtreemass[1:])), compiled.opt.timestep)
    try:
        static = _Model(compiled, penalty, contact_pairs)
    except (NotImplementedError, AssertionError) as error:
        remedy = ", or give contact_pairs one of these kinds" if "collisions not implemented" in str(error) else ""
        raise ValueError(
            f"MJX does not support this model ({error}): remove that, or set contype and conaffinity of "
            f"such geoms to 0{remedy}"
        ) from error
    gravity = np.zeros(3) if mjcf.is_disabled(compiled, "GRAVITY") else compiled.opt.gravity
    real = jnp.zeros(()).dtype
    return RigidModel(
        # Converted by NumPy, and with a dtype: otherwise JAX compiles a program for each shape.
        parameters={name: jnp.asarray(value.astype(real), real) for name, value in parameters.items()},
        gravity=jnp.asarray(gravity.astype(real), real),
        penalty=jax.tree.map(lambda value: jnp.asarray(value, real), penalty),
        static=static,
    )


def check_state(model: RigidModel, state: RigidState) -> None:
    """Raises ValueError unless these are a model and a state of this model."""
    check_instance("model", model, RigidModel, "give a model that rigid.load returned")
    check_instance("state", state, RigidState, "give a state that rigid.initial_state returned")
    for name, size in (("qpos", model.num_positions), ("qvel", model.num_dofs)):
        check_shape(f"the state's {name}", getattr(state, name), (size,), " of this model (map batches with jax.vmap)")


def check_shape(name: str, value: Array, shape: tuple[int, ...], what: str = "") -> None:
    """Raises ValueError unless an array has the shape; the message explains the shape with ``what``."""
    if np.shape(value) != shape:
        raise ValueError(f"{name} has shape {np.shape(value)}: give shape {shape}{what}")
