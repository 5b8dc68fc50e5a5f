"""Vertices (the state) and the scene of tetrahedra (everything constant), checked when they are built."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics.contact.colliders import COLLIDERS, Collider
from rewax.physics.contact.contact_checks import check_ground, check_rotations, penalty_numbers
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.contact.vertex_checks import (
    check_dt,
    check_has_law,
    check_length,
    check_vectors,
    contact_numbers,
    gravity_number,
    held_indices,
)
from rewax.physics.numerics.checks import FINITE, GRAVITY, POSITIVE, Number, any_illegal, check_numbers
from rewax.physics.numerics.fields import check_fields, checked, instance, member, real, static
from rewax.physics.numerics.pose import Pose
from rewax.physics.tets.edges import TetTopology
from rewax.physics.tets.law import DampingLaw, wave_modulus
from rewax.physics.tets.scene_checks import check_moduli, material_numbers
from rewax.physics.tets.tetmesh import TetMesh, check_tetmesh
from rewax.types import Array, Scalar, Vector

DAMPING_LAW = member(DampingLaw)
_SCENE = {
    "dt": static(POSITIVE, "give the duration of a substep in seconds"),
    "colliders": COLLIDERS,
    "damping_law": DAMPING_LAW,
}
STABLE_FRACTION = 0.8
"""``largest_stable_dt`` returns this fraction of the theoretical bound."""


@struct.dataclass
class TetState(struct.Replaceable):
    """Vertices.

    Attributes:
      x: position [m], shape (num_vertices, 3).
      v: velocity [m/s], shape (num_vertices, 3).
    """

    x: Array
    v: Array


@struct.dataclass
class TetScene(struct.Replaceable):
    """The constant part of a simulation; build it with ``make_scene``, which checks it.

    Parameters of the material are numbers, or arrays of shape (num_tets,).

    Attributes:
      topology: the tets (static).
      dt: duration of a substep [s] (static).
      inverse_rest_edges: inverse of each tet's edge matrix at rest (columns: edges from vertex 0 to 1, 2, 3) [1/m],
        shape (num_tets, 3, 3).
      rest_volume: volume of each tet at rest [m^3], shape (num_tets,).
      mass: mass of each vertex [kg], shape (num_vertices,).
      mu, lam: parameters of the stable neo-Hookean law [Pa]. ``tets.small_strain_moduli(mu, lam)`` converts them to
        Young's modulus and Poisson's ratio, ``tets.stable_parameters`` converts back.
      damping: viscosity [Pa s]; None: no damping, and its terms are not traced.
      activation: shift of the volume ratio at rest [-]; positive contracts.
      gravity: acceleration [m/s^2], shape (3,).
      mobility: 1 for vertices that move, 0 for those that keep their velocity, shape (num_vertices,); None: all move.
      contact: penalty law of ground and colliders.
      ground: the ground, or None.
      colliders: moving shapes.
      damping_law: the rate that damping acts on (static).
    """

    topology: TetTopology = struct.static_field()
    dt: float = struct.static_field()
    inverse_rest_edges: Array
    rest_volume: Array
    mass: Array
    mu: Scalar
    lam: Scalar
    damping: Scalar | None = None
    activation: Scalar = 0.0
    gravity: Vector = struct.number(FINITE, GRAVITY, shape=(3,))
    mobility: Array | None = None
    contact: PenaltyContact | None = None
    ground: Ground | None = None
    colliders: tuple[Collider, ...] = ()
    damping_law: DampingLaw = struct.static_field(default=DampingLaw.VELOCITY_GRADIENT)

    def __post_init__(self) -> None:
        DAMPING_LAW("damping_law", self.damping_law)

    @property
    def tets(self) -> np.ndarray:
        """The four vertices of each tet, int32 of shape (num_tets, 4)."""
        return self.topology.tets


def check_vertices(scene: TetScene, state: TetState) -> None:
    """Raises ValueError for a state with another number of vertices than the scene."""
    check_vectors(scene.topology.num_vertices, **{"state.x": state.x, "state.v": state.v})


SCENE = instance(TetScene, "give a scene of tets.make_scene")
STATE = instance(TetState, "give a state of tets.initial_state or tets.step")


@checked(x=real(FINITE, "give positions in metres", shape=("num_vertices", 3)))
def initial_state(x: Any) -> TetState:
    """Vertices at rest.

    Args:
      x: positions [m], shape (num_vertices, 3): ``mesh.vertices``, possibly moved or strained.

    Raises:
      ValueError: another shape, or a position that is not finite. Only the shape of traced positions is checked.
    """
    x = jnp.asarray(x, float) if isinstance(x, np.ndarray) else jnp.asarray(x)
    x = x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)
    return TetState(x=x, v=jnp.zeros_like(x))


def make_scene(
    *,
    mesh: TetMesh,
    density: Any,
    mu: Scalar,
    lam: Scalar,
    dt: float,
    damping: Scalar | None = None,
    activation: Scalar = 0.0,
    gravity: Any = (0.0, -9.81, 0.0),
    held: Any = (),
    contact: PenaltyContact | None = None,
    ground: Ground | None = None,
    colliders: tuple[Collider, ...] = (),
    damping_law: DampingLaw = DampingLaw.VELOCITY_GRADIENT,
) -> TetScene:
    """A checked ``TetScene`` of a mesh at rest; a tet's mass goes to its four vertices in equal parts.

    Args:
      mesh: vertices at rest and tets.
      density: [kg/m^3], shape () or (num_tets,).
      held: vertices that keep their velocity (0 if they start at rest): indices, or a mask of shape (num_vertices,).

    All arguments but ``mesh``, ``density`` and ``held`` are fields of ``TetScene``.

    Raises:
      ValueError: a mesh that ``check_tetmesh`` rejects, an illegal value (not finite; a modulus, density or size that
        is not positive; damping or friction below 0), parameters of an unstable material (lam <= mu / 8) or of a wrong
        shape, ground or colliders without a contact law, a dt above ``largest_stable_dt``. The message names field,
        value and remedy. ``check_status`` sets ``Status.INVALID_PARAMETERS`` for illegal traced values.
    """
    check_fields(_SCENE, locals())
    check_tetmesh(mesh)
    num_tets, num_vertices = len(mesh.tets), len(mesh.vertices)
    dt = float(dt)
    if ground is not None:
        check_ground(ground)
    density_number = Number("density", density, POSITIVE, "give the rest density in kg/m^3")
    numbers = material_numbers(mu, lam, damping, activation)
    check_rotations(colliders)
    check_numbers([density_number, *numbers, *contact_numbers(contact, ground, colliders), gravity_number(gravity)])
    for number in (density_number, *numbers):
        check_length(number, num_tets)
    for number in () if contact is None else penalty_numbers(contact):
        check_length(number, num_vertices)
    check_moduli(mu, lam)
    check_has_law(contact, ground, colliders)
    held = held_indices(held, num_vertices)
    corners = np.asarray(mesh.vertices, np.float64)[mesh.tets]
    rest_edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    share = jnp.asarray(mesh.volumes / 4.0, float) * jnp.asarray(density, float)
    scene = TetScene(
        topology=TetTopology(mesh.tets, num_vertices),
        dt=dt,
        inverse_rest_edges=jnp.asarray(np.linalg.inv(rest_edges), float),
        rest_volume=jnp.asarray(mesh.volumes, float),
        mass=jnp.zeros(num_vertices, share.dtype).at[mesh.tets].add(share[:, None]),
        mu=mu,
        lam=lam,
        damping=damping,
        activation=activation,
        gravity=gravity,
        mobility=jnp.ones(num_vertices).at[held].set(0.0) if held.size else None,
        contact=contact,
        ground=ground,
        colliders=tuple(colliders),
        damping_law=damping_law,
    )
    check_dt(dt, largest_stable_dt(scene))
    return scene


def largest_stable_dt(scene: TetScene) -> Scalar:
    """Largest substep [s] at which the explicit integration of a body at rest stays stable.

    The stiffness at a vertex of mass m is at most K = sum over its tets of volume M sum_k |grad N_k|^2, plus the
    contact's stiffness. Here M is the P-wave modulus, and N_k are the tet's linear shape functions. The damping is
    at most the same sum with 2 damping instead of M, plus the contact's damping. Symplectic Euler is stable
    up to 4 / (c + sqrt(c^2 + 4 w^2)) with w^2 = K / m and c the damping over m. The result is 0.8 of the smallest bound
    of all vertices.

    The factor was measured over 2000 substeps on boxes of 5 and 6 tets per cell, on long and distorted boxes, and on
    the table of SoftJumper. Poisson's ratio was 0 to 0.45, and vertices were displaced at random by 1 or 10 % of a
    tet's smallest size. Without damping these bodies become unstable between 1.1 (nu 0.45, 10 %) and 1.6 of the
    smallest bound, and with strong damping between 1.6 and 2.7. Linear theory predicts 1.3 to 1.6. Stronger compression
    needs an extra margin. The bound ignores the damping of friction and ``depth_damping``. It counts contact once,
    although several bodies can push one vertex.

    Gradient: exact.
    """
    M = wave_modulus(scene.mu, scene.lam)
    B = scene.inverse_rest_edges
    slopes = jnp.sum(B**2, axis=(1, 2)) + jnp.sum(jnp.sum(B, axis=1) ** 2, axis=1)
    zeros = jnp.zeros_like(scene.mass)
    weight = scene.rest_volume * slopes
    damping = jnp.asarray(0.0 if scene.damping is None else scene.damping)
    if jnp.ndim(M) == damping.ndim == 0:
        weight = zeros.at[scene.tets].add(weight[:, None])
        stiffness, damping = weight * M, weight * 2.0 * damping
    else:
        stiffness = zeros.at[scene.tets].add((weight * M)[:, None])
        damping = zeros.at[scene.tets].add((weight * 2.0 * damping)[:, None])
    if scene.contact is not None:
        stiffness, damping = stiffness + scene.contact.stiffness, damping + scene.contact.damping
    w2, c = stiffness / scene.mass, damping / scene.mass
    limit = 4.0 / (c + jnp.sqrt(c * c + 4.0 * w2))
    if scene.mobility is not None:
        limit = jnp.where(scene.mobility > 0, limit, jnp.inf)
    return STABLE_FRACTION * jnp.min(limit)


def has_invalid_parameters(scene: TetScene, poses: Pose | None = None) -> Array:
    """Whether a scene has a value that ``make_scene`` rejects, shape (), bool; also for traced or replaced values.

    Args:
      scene: the scene.
      poses: poses of its bodies, of any shape; None: not checked.

    Gradient: none.
    """
    numbers = [
        *material_numbers(scene.mu, scene.lam, scene.damping, scene.activation),
        Number("mass", scene.mass, POSITIVE, "give the vertices' masses in kg"),
        Number("rest_volume", scene.rest_volume, POSITIVE, "give the tets' volumes in m^3"),
        *contact_numbers(scene.contact, scene.ground, scene.colliders, poses),
        gravity_number(scene.gravity),
    ]
    soft = jnp.any(jnp.asarray(scene.lam) <= jnp.asarray(scene.mu) / 8)
    # The tolerance keeps a dt at the limit legal when the limit is rounded to float32.
    too_long = ~(scene.dt <= (1.0 + 1e-5) * largest_stable_dt(scene))
    return any_illegal(numbers) | soft | too_long


__all__ = ["TetScene", "TetState", "initial_state", "largest_stable_dt", "make_scene"]
