"""Deformable tetrahedra: substep, step, forces, status.

Linear tetrahedra with masses lumped at the vertices. One substep: forces from elastic, active and damping stress of the
tets, gravity, penalty contact with the ground and with moving shapes, symplectic Euler.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.fusion import materialize
from rewax.lowering.kernels import joined, pointwise, separated
from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import check_bodies, shape_pose
from rewax.physics.contact.patches import WALLS
from rewax.physics.contact.penalty import collider_force, ground_force
from rewax.physics.contact.vertex_checks import check_vectors
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import check_precision
from rewax.physics.numerics.components import Mat3, Vec3
from rewax.physics.numerics.fields import checked, instance, optional, poses
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.numerics.substeps import both_ends, scan_substeps
from rewax.physics.shapes.solid import distance_to
from rewax.physics.tets.edges import edges, gather_forces
from rewax.physics.tets.law import DampingLaw, first_piola_stress
from rewax.physics.tets.scene import SCENE, STATE, TetScene, TetState, check_vertices, has_invalid_parameters
from rewax.status import Status, all_finite, flag
from rewax.types import Array, Scalar


class Vertices(NamedTuple):
    """``TetState`` by components, for the inner loop."""

    x: Vec3
    v: Vec3


class Rest(NamedTuple):
    """The scene's arrays that a substep needs, by components, split once per step."""

    inverse_edges: Mat3
    volume: Array
    inverse_mass: Array


@checked(scene=SCENE, state=STATE, before=poses("num_bodies"), after=poses("num_bodies"))
def substep(scene: TetScene, state: TetState, before: Pose, after: Pose) -> TetState:
    """One substep of duration ``scene.dt``: v' = v + dt (f(x, v) / m + g), x' = x + dt v'.

    Args:
      scene: the scene.
      state: vertices.
      before, after: poses of all bodies at its beginning and end, shapes (num_bodies, 3), (num_bodies, 3, 3).

    Gradient: exact with respect to the state, the poses and every array of the scene, forward and reverse; one-sided at
      the onset of contact and at Coulomb's limit, see ``contact.penalty_force``.
    Source: the soft meshes of NVIDIA Warp's semi-implicit integrator. Deviation: damping, see ``law``.
    """
    check_vertices(scene, state)
    check_bodies(scene.colliders, before.position.shape[0])
    return join(_recomputed_substep(scene, rest(scene), split(state), (before, after)))


@checked(scene=SCENE, state=STATE, poses=poses("num_substeps + 1", "num_bodies"))
def step(scene: TetScene, state: TetState, poses: Pose, *, store_every: int | None = 1) -> TetState:
    """Advance vertices by the substeps between ``poses``.

    Args:
      scene: the scene.
      state: vertices.
      poses: poses of all bodies at the num_substeps + 1 boundaries of substeps, shapes (num_substeps + 1, num_bodies,
        3) and (num_substeps + 1, num_bodies, 3, 3); see ``mpm.static_poses`` for a scene without bodies.
      store_every: as for ``mpm.step``: the backward pass stores vertices every ``store_every`` substeps and recomputes
        the rest; None: it stores everything.

    Gradient: exact, as for ``substep``. Source: as for ``substep``.

    Raises:
      ValueError: the state or the poses do not fit the scene, ``store_every`` does not divide the number of substeps,
        or state and scene differ in precision.
    """
    check_vertices(scene, state)
    check_bodies(scene.colliders, poses.position.shape[1])
    check_precision(state.x, scene.gravity, poses.position)
    constants = rest(scene)
    one = _substep if store_every is None else _recomputed_substep

    def body(vertices: Vertices, interval: tuple[Pose, Pose]) -> Vertices:
        return one(scene, constants, vertices, interval)

    return join(scan_substeps(body, split(state), both_ends(poses), store_every))


@checked(scene=SCENE, state=STATE)
def internal_force(scene: TetScene, state: TetState) -> Array:
    """Elastic, active and damping forces on the vertices [N], shape (num_vertices, 3); they sum to zero.

    Without damping they are minus the gradient of ``elastic_energy``. Gradient: exact.
    """
    check_vertices(scene, state)
    return cp.join_vector(vertex_forces(scene, rest(scene), *split(state)))


@checked(scene=SCENE, state=STATE, before=poses("num_bodies"), after=poses("num_bodies"))
def contact_force(scene: TetScene, state: TetState, before: Pose, after: Pose) -> Array:
    """Forces of ground and colliders on the vertices [N], shape (num_vertices, 3); poses as for ``substep``.

    Gradient: exact, see ``contact.penalty_force``.
    """
    check_vertices(scene, state)
    check_bodies(scene.colliders, before.position.shape[0])
    return cp.join_vector(contact_forces(scene, *split(state), (before, after)))


def deformation_gradient(scene: TetScene, x: Array) -> Array:
    """Deformation gradient of each tet [-], shape (num_tets, 3, 3); det F < 0 where inverted. Gradient: exact."""
    check_vectors(scene.topology.num_vertices, x=x)
    return cp.join_matrix(deformation(scene, rest(scene), cp.split_vector(x)))


@checked(scene=SCENE, state=STATE, poses=optional(instance(Pose, "give a Pose, or None")))
def check_status(scene: TetScene, state: TetState, *, poses: Pose | None = None) -> Array:
    """Status bits of a state (non-finite numbers, flat or inverted tets) and of a scene (illegal numbers).

    Contact acts on vertices. A collider that is smaller than the triangles between them can pass into a body without
    any force; with its center inside of a tet it sets ``PENETRATION``.

    Args:
      scene: the scene.
      state: vertices.
      poses: poses of its bodies, as for ``step``, to check that they are finite, and for ``PENETRATION`` at the last.

    Returns:
      Bits of ``rewax.status.Status``, shape (), int32. Gradient: none.
    """
    check_vertices(scene, state)
    state = jax.lax.stop_gradient(state)
    inverted = jnp.any(cp.det(deformation(scene, rest(scene), cp.split_vector(state.x))) <= 0)
    pierced = jnp.asarray(False) if poses is None else _is_pierced(scene, state.x, Pose(*(a[-1] for a in poses)))
    return (
        flag(~all_finite(state), Status.NAN)
        | flag(inverted, Status.INVERTED)
        | flag(pierced, Status.PENETRATION)
        | flag(has_invalid_parameters(scene, poses), Status.INVALID_PARAMETERS)
    )


def _is_pierced(scene: TetScene, x: Array, bodies: Pose) -> Array:
    """Whether the center of a collider, if it is solid there, lies inside of a tet, shape ()."""
    corners = x[np.asarray(scene.topology.tets)]
    a, b, c = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    normals = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    volume = jnp.sum(a * normals[:, 0], axis=-1, keepdims=True)
    found = jnp.asarray(False)
    for collider in scene.colliders:
        center = shape_pose(collider, body_pose(bodies, collider.body)).position
        shares = jnp.einsum("nij,nj->ni", normals, center - corners[:, 0], precision="highest")
        within = jnp.all(shares >= 0, axis=1) & (jnp.sum(shares, axis=1) <= volume[:, 0])
        zero = jnp.zeros_like(center[0])
        found |= jnp.any(within) & (distance_to(collider.shape, (zero, zero, zero))[0] < 0)
    return found


# --- One substep, by components ---------------------------------------------------------------------------------------


def _substep(scene: TetScene, rest: Rest, vertices: Vertices, interval: tuple[Pose, Pose]) -> Vertices:
    vertices = materialize(vertices)
    x, v = vertices
    with jax.named_scope("tets"):
        force = vertex_forces(scene, rest, x, v)
    with jax.named_scope("contact"):
        contact = contact_forces(scene, x, v, interval)
    return moved(scene, rest, vertices, force, contact)


_recomputed_substep = recomputed(_substep)


def moved(scene: TetScene, rest: Rest, vertices: Vertices, force: Vec3, contact: Vec3) -> Vertices:
    """Vertices a substep later, given the forces of tets and contact [N]. Gradient: exact."""
    with jax.named_scope("update"):
        shared = (scene.gravity, scene.dt)
        return _moved(shared, (vertices, force, contact, rest.inverse_mass, scene.mobility))


@pointwise
def _moved(shared: tuple[Array, Scalar], given: tuple[Vertices, Vec3, Vec3, Array, Array | None]) -> Vertices:
    (g, dt), ((x, v), force, contact, inverse_mass, mobility) = shared, given
    gain = 1.0 if mobility is None else mobility
    v = cp.vector(lambda i: v[i] + dt * gain * ((force[i] + contact[i]) * inverse_mass + g[i]))
    return Vertices(cp.vector(lambda i: x[i] + dt * v[i]), v)


def deformation(scene: TetScene, rest: Rest, x: Vec3) -> Mat3:
    return cp.matmul(edges(scene.topology, x), rest.inverse_edges)


def vertex_forces(scene: TetScene, rest: Rest, x: Vec3, v: Vec3) -> Vec3:
    """``internal_force`` by components."""
    damped = scene.damping is not None
    at_rest = (rest.inverse_edges, rest.volume)
    now = (edges(scene.topology, x), edges(scene.topology, v) if damped else None)
    shared, own = separated((scene.mu, scene.lam, scene.activation, scene.damping))
    return gather_forces(scene.topology, _columns(scene.damping_law)(shared, (own, at_rest, now)))


@functools.cache
def _columns(damping_law: DampingLaw) -> Callable[[Any, Any], Mat3]:
    """Forces of each tet on its vertices 1, 2, 3 [N], the columns of a matrix."""

    @pointwise
    def columns(shared: Any, tets: tuple[Any, tuple[Mat3, Array], tuple[Mat3, Mat3 | None]]) -> Mat3:
        own, (inverse_edges, volume), (now, rates) = tets
        mu, lam, activation, damping = joined(shared, own)
        damping = 0.0 if damping is None else damping
        F = materialize(cp.matmul(now, inverse_edges))
        rate = None if rates is None else materialize(cp.matmul(rates, inverse_edges))
        stress = materialize(
            first_piola_stress(F, rate, mu=mu, lam=lam, activation=activation, damping=damping, damping_law=damping_law)
        )
        forces = materialize(cp.matmul(stress, cp.transpose(inverse_edges)))
        return cp.matrix(lambda i, k: -volume * forces[i][k])

    return columns


def contact_forces(scene: TetScene, x: Vec3, v: Vec3, interval: tuple[Pose, Pose] | None) -> Vec3:
    """``contact_force`` by components; with ``interval`` None that of the ground alone."""
    return total_force([force for _, force in each_contact_force(scene, x, v, interval)], x)


def each_contact_force(scene: TetScene, x: Vec3, v: Vec3, interval: tuple[Pose, Pose] | None) -> list[tuple[int, Vec3]]:
    """Bodies, and the forces of each on the vertices [N]; the ground's body is ``WALLS``. Gradient: exact."""
    if scene.contact is None:
        return []
    forces = [] if scene.ground is None else [(WALLS, ground_force(scene.ground, scene.contact, x, v))]
    if interval is not None:
        for collider in scene.colliders:
            start, end = (body_pose(pose, collider.body) for pose in interval)
            forces.append((collider.body, collider_force(collider, scene.contact, x, v, start, end, scene.dt)))
    return forces


def total_force(forces: Sequence[Vec3], x: Vec3) -> Vec3:
    """Sum of forces on the vertices at x; zero for none."""
    return functools.reduce(cp.add, forces) if forces else cp.vector(lambda i: jnp.zeros_like(x[i]))


def rest(scene: TetScene) -> Rest:
    """The scene's arrays that substeps need."""
    return Rest(cp.split_matrix(scene.inverse_rest_edges), scene.rest_volume, 1.0 / scene.mass)


def split(state: TetState) -> Vertices:
    """Components of a state."""
    return Vertices(cp.split_vector(state.x), cp.split_vector(state.v))


def join(vertices: Vertices) -> TetState:
    """Inverse of ``split``."""
    return TetState(x=cp.join_vector(vertices.x), v=cp.join_vector(vertices.v))


__all__ = [
    "Rest",
    "Vertices",
    "check_status",
    "contact_force",
    "contact_forces",
    "deformation_gradient",
    "each_contact_force",
    "internal_force",
    "join",
    "moved",
    "rest",
    "split",
    "step",
    "substep",
    "total_force",
    "vertex_forces",
]
