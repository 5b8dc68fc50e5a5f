"""Vertices (the state) and the scene of cloth and ropes (everything constant), checked when they are built."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.physics.contact.colliders import COLLIDERS, Collider
from rewax.physics.contact.contact_checks import check_ground, check_rotations
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.contact.vertex_checks import check_dt, check_has_law, check_vectors, held_indices
from rewax.physics.numerics.checks import FINITE, GRAVITY, NOT_NEGATIVE, POSITIVE, check_numbers
from rewax.physics.numerics.fields import check_fields, checked, instance, member, optional, real, static
from rewax.physics.thin.contact_elements import ContactElements
from rewax.physics.thin.grasps import GRASPS, Grasp, Hold, check_grasps
from rewax.physics.thin.implicit import Implicit
from rewax.physics.thin.materials import BendingLaw, Cloth, MembraneLaw, Rope
from rewax.physics.thin.pair_law import SelfContact
from rewax.physics.thin.rest import RestShape, rest_shape, vertex_mass
from rewax.physics.thin.safe_speed import ThicknessLimits, check_max_speed, check_self_contact
from rewax.physics.thin.scene_checks import check_lengths, check_materials, check_stepper, scene_numbers
from rewax.physics.thin.stable_dt import largest_stable_dt
from rewax.physics.thin.stencils import Stencil, Topology
from rewax.physics.thin.thinmesh import ThinMesh, bends, check_thinmesh, hinges
from rewax.types import Array, Scalar, Vector


def _direction(name: str, value: Any) -> None:
    """A rule: three finite numbers, not all of them zero."""
    real(FINITE, "give a direction", shape=(3,))(name, value)
    if not isinstance(value, Tracer) and not np.any(np.asarray(value)):
        raise ValueError(f"{name} is the zero vector, which has no direction: give (1, 0, 0) for the x axis")


_LAW = member(MembraneLaw)
_BENDING = member(BendingLaw)
_SCENE = {
    "mesh": instance(ThinMesh, "give a ThinMesh, from thin.sheet or thin.rope for example"),
    "dt": static(POSITIVE, "give the duration of a substep in seconds"),
    "cloth": optional(instance(Cloth, "give a Cloth, from thin.isotropic_cloth for example")),
    "rope": optional(instance(Rope, "give a Rope(stretch=..., density=...)")),
    "contact": optional(instance(PenaltyContact, "give a PenaltyContact(stiffness=...)")),
    "colliders": COLLIDERS,
    "self_contact": optional(instance(SelfContact, "give a SelfContact(thickness=..., stiffness=...)")),
    "law": _LAW,
    "bending_law": _BENDING,
    "warp": _direction,
    "stepper": optional(instance(Implicit, "give a thin.Implicit(), or None for explicit steps")),
    "grasps": GRASPS,
}


@struct.dataclass
class ThinState(struct.Replaceable):
    """Vertices.

    Attributes:
      x: position [m], shape (num_vertices, 3).
      v: velocity [m/s], shape (num_vertices, 3).
      error: largest error of velocities that the implicit substeps of the last ``step`` left [m/s], shape ().
        Gradient: none.
      crease: plastic part of the rest angle of hinges [rad], shape (num_hinges,), see ``no_creases``; None for cloth
        that does not yield.
      filled: largest number of close pairs over the length of their list [-], of all steps with self-contact since
        ``initial_state``, shape (); above 1, pairs were missed. Gradient: none.
      speed: largest speed of a vertex relative to the mean velocity [m/s], likewise.
      holds: where each grasp of the scene holds its vertices, see ``open_grasps``; () without grasps.
    """

    x: Array
    v: Array
    error: Scalar = struct.number(NOT_NEGATIVE, "give 0", shape=(), default=0.0)
    crease: Array | None = None
    filled: Scalar = struct.number(NOT_NEGATIVE, "give 0", shape=(), default=0.0)
    speed: Scalar = struct.number(NOT_NEGATIVE, "give 0", shape=(), default=0.0)
    holds: tuple[Hold, ...] = ()


@struct.dataclass
class ThinScene(struct.Replaceable):
    """The constant part of a simulation; build it with ``make_scene``, which checks it.

    Attributes:
      topology: elements and held vertices (static).
      dt: duration of a substep [s] (static).
      rest: sizes of the elements at rest.
      mass: mass of each vertex [kg], shape (num_vertices,).
      cloth, rope: materials; None without triangles or without segments.
      drag: deceleration per velocity [1/s].
      gravity: acceleration [m/s^2], shape (3,).
      mobility: 1 for vertices that move, 0 for held ones, shape (num_vertices,); None: all move.
      contact: penalty law of ground and colliders.
      ground: the ground, or None.
      colliders: moving shapes.
      law: the membrane's law (static).
      bending_law: the law of bending of cloth (static).
      self_contact: law of contact with itself, or None.
      contact_elements: what touches in self-contact (static).
      thickness_limits: the thickness for which they are right, or None.
      stepper: settings of implicit steps (static); None: explicit ones.
      grasps: grippers that hold vertices.
    """

    topology: Topology = struct.static_field()
    dt: float = struct.static_field()
    rest: RestShape
    mass: Array
    cloth: Cloth | None = None
    rope: Rope | None = None
    drag: Scalar = struct.number(NOT_NEGATIVE, "give a rate in 1/s, 0 for none", shape=(), default=0.0)
    gravity: Vector = struct.number(FINITE, GRAVITY, shape=(3,))
    mobility: Array | None = None
    contact: PenaltyContact | None = None
    ground: Ground | None = None
    colliders: tuple[Collider, ...] = ()
    law: MembraneLaw = struct.static_field(default=MembraneLaw.SAINT_VENANT_KIRCHHOFF)
    bending_law: BendingLaw = struct.static_field(default=BendingLaw.PLATE)
    self_contact: SelfContact | None = None
    contact_elements: ContactElements | None = struct.static_field(default=None)
    thickness_limits: ThicknessLimits | None = None
    stepper: Implicit | None = struct.static_field(default=None)
    grasps: tuple[Grasp, ...] = ()

    def __post_init__(self) -> None:
        _LAW("law", self.law)
        _BENDING("bending_law", self.bending_law)


def check_vertices(scene: ThinScene, state: ThinState) -> None:
    """Raises ValueError for a state with another number of vertices than the scene."""
    check_vectors(scene.topology.triangles.num_vertices, **{"state.x": state.x, "state.v": state.v})


SCENE = instance(ThinScene, "give a scene of thin.make_scene")
STATE = instance(ThinState, "give a state of thin.initial_state or thin.step")


@checked(x=real(FINITE, "give positions in metres", shape=("num_vertices", 3)))
def initial_state(x: Any) -> ThinState:
    """Vertices without velocity at positions x [m], shape (num_vertices, 3).

    Raises:
      ValueError: another shape, or a position that is not finite. Only the shape of traced positions is checked.

    Gradient: exact.
    """
    x = jnp.asarray(x, float) if isinstance(x, np.ndarray) else jnp.asarray(x)
    x = x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)
    error, filled, speed = (jnp.zeros((), x.dtype) for _ in range(3))  # three buffers, so that a state can be donated
    return ThinState(x=x, v=jnp.zeros_like(x), error=error, filled=filled, speed=speed)


@checked(scene=SCENE, state=STATE)
def no_creases(scene: ThinScene, state: ThinState) -> ThinState:
    """The state without creases. Scenes of cloth with a ``yield_curvature`` begin with it."""
    return state.replace(crease=jnp.zeros(len(scene.topology.hinges), state.x.dtype))


def make_scene(
    *,
    mesh: ThinMesh,
    dt: float,
    cloth: Cloth | None = None,
    rope: Rope | None = None,
    drag: Scalar = 0.0,
    gravity: Any = (0.0, -9.81, 0.0),
    held: Any = (),
    contact: PenaltyContact | None = None,
    ground: Ground | None = None,
    colliders: tuple[Collider, ...] = (),
    law: MembraneLaw = MembraneLaw.SAINT_VENANT_KIRCHHOFF,
    bending_law: BendingLaw = BendingLaw.PLATE,
    warp: Any = (1.0, 0.0, 0.0),
    self_contact: SelfContact | None = None,
    stepper: Implicit | None = None,
    grasps: tuple[Grasp, ...] = (),
) -> ThinScene:
    """A checked ``ThinScene`` of a mesh.

    Args:
      mesh: vertices at rest, triangles and segments.
      held: vertices that keep their velocity or follow the ``pins`` of ``step``: indices, or a mask (num_vertices,).
      warp: direction of the warp for a mesh without pattern, see ``rest_shape``.

    All arguments but ``mesh``, ``held`` and ``warp`` are fields of ``ThinScene``.

    Raises:
      ValueError: a faulty mesh, an illegal value, triangles without ``cloth`` or segments without ``rope``, an unstable
        material, ground or colliders without a contact law, a dt above ``largest_stable_dt``; a grasp without vertices
        and radius; self-contact that is traced, too thick or has a ``max_speed`` above ``largest_safe_speed``; with a
        ``stepper``, grasps or a contact with damping and without onset. The message names field, value and remedy.
        ``check_status`` sets ``Status.INVALID_PARAMETERS`` for illegal traced values.
    """
    check_fields(_SCENE, locals())
    check_thinmesh(mesh)
    count, dt = len(mesh.vertices), float(dt)
    held = held_indices(held, count)
    topology = Topology(
        Stencil(mesh.triangles, count),
        Stencil(hinges(mesh.triangles), count),
        Stencil(mesh.segments, count),
        Stencil(bends(mesh.segments), count),
        Stencil(held[:, None], count),
    )
    check_materials(topology, cloth, rope, law)
    if ground is not None:
        check_ground(ground)
    check_rotations(colliders)
    check_numbers(scene_numbers(cloth, rope, drag, gravity, contact, ground, colliders))
    check_grasps(grasps, count)
    check_lengths(topology, cloth, rope, contact, bending_law)
    check_has_law(contact, ground, colliders)
    check_stepper(stepper, contact, grasps)
    rest = _rest(topology, mesh.vertices, mesh.pattern, warp)
    if isinstance(rest.area, Tracer):  # inside a traced function
        with jax.ensure_compile_time_eval():
            rest = _rest(topology, mesh.vertices, mesh.pattern, warp)
    contact_elements, thickness_limits = check_self_contact(topology, mesh, rest, self_contact)
    scene = ThinScene(
        topology=topology,
        dt=dt,
        rest=rest,
        mass=_mass(topology, rest, cloth, rope),
        cloth=cloth,
        rope=rope,
        drag=drag,
        gravity=gravity,
        mobility=jnp.ones(count).at[held].set(0.0) if held.size else None,
        contact=contact,
        ground=ground,
        colliders=tuple(colliders),
        law=law,
        bending_law=bending_law,
        self_contact=self_contact,
        contact_elements=contact_elements,
        thickness_limits=thickness_limits,
        stepper=stepper,
        grasps=tuple(grasps),
    )
    check_dt(dt, largest_stable_dt(scene))
    check_max_speed(scene)
    return scene


# One compiled program: run operation by operation, XLA would compile hundreds.
_mass = jax.jit(vertex_mass, static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def _rest(topology: Topology, vertices: Any, pattern: Any, warp: Any) -> RestShape:
    return rest_shape(topology, vertices, pattern=pattern, warp=warp)


__all__ = ["ThinScene", "ThinState", "check_vertices", "initial_state", "make_scene", "no_creases"]
