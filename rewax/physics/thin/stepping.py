"""Cloth and ropes: substep, step, forces.

One substep: forces of membrane, bending, segments and bends, gravity, drag, penalty contact with the ground and with
moving shapes, grasps, symplectic Euler. Held vertices keep their velocity or follow prescribed positions.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.lowering.kernels import pointwise
from rewax.lowering.recompute import recomputed
from rewax.physics.contact.colliders import check_bodies
from rewax.physics.contact.penalty import collider_force, ground_force
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, check_precision
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.fields import checked, optional, poses, real
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.numerics.substeps import both_ends, scan_substeps
from rewax.physics.thin import elements, grasp_forces
from rewax.physics.thin.bending import bending_forces
from rewax.physics.thin.creases import creased, yield_angle, yielded
from rewax.physics.thin.grasps import check_grasp_bodies
from rewax.physics.thin.implicit_step import Step, implicit_step, reach
from rewax.physics.thin.incremental import inverse_edges
from rewax.physics.thin.prescribed import Prescribed, checked_prescribed
from rewax.physics.thin.scene import SCENE, STATE, ThinScene, ThinState, check_vertices
from rewax.physics.thin.scene_checks import check_creases
from rewax.physics.thin.self_contact import AllPairs, Seen, close_pairs, scan_rounds, self_forces, watched_pairs
from rewax.physics.thin.stencils import scatter
from rewax.types import Array, Scalar


class Vertices(NamedTuple):
    """``ThinState`` by components, for the inner loop."""

    x: Vec3
    v: Vec3
    holds: tuple[grasp_forces.HoldParts, ...] = ()


class Creased(NamedTuple):
    """Vertices with the creases of cloth that yields."""

    x: Vec3
    v: Vec3
    holds: tuple[grasp_forces.HoldParts, ...]
    crease: Array


class Solved(NamedTuple):
    """Vertices after an implicit substep."""

    x: Vec3
    v: Vec3
    error: Array
    crease: Array | None


class Interval(NamedTuple):
    """Poses, pins and grips of a substep."""

    poses: tuple[Pose, Pose]
    prescribed: Prescribed


@checked(
    scene=SCENE,
    state=STATE,
    poses=poses("num_substeps + 1", "num_bodies"),
    pins=optional(real(FINITE, "give positions of held vertices in metres", shape=("num_substeps", "num_held", 3))),
)
def step(
    scene: ThinScene,
    state: ThinState,
    poses: Pose,
    *,
    pins: Array | None = None,
    grips: Array | None = None,
    store_every: int | None = 1,
) -> ThinState:
    """Advance vertices by the substeps between ``poses``: v' = v + dt (f(x, v) / m + g - drag v), x' = x + dt v'.

    With ``scene.stepper`` forces and drag are those of x' and v', see ``implicit_step``.

    Args:
      scene: the scene.
      state: vertices.
      poses: poses of all bodies at the num_substeps + 1 boundaries of substeps, shapes (num_substeps + 1, num_bodies,
        3) and (num_substeps + 1, num_bodies, 3, 3); ``thin.static_poses`` for a scene without bodies.
      pins: positions of the held vertices at the end of each substep [m], shape (num_substeps, num_held, 3), in the
        order of ``make_scene``'s ``held``; None: they keep their velocity.
      grips: how far each grasp of the scene is closed, from 0 (open) to 1, shape (num_substeps, num_grasps), or
        (num_grasps,) for the whole step; None for a scene without grasps. They are clipped to [0, 1].
      store_every: the backward pass stores vertices every ``store_every`` substeps and recomputes the rest; None: it
        stores everything.

    Gradient: exact with respect to the state, the poses, the pins, the grips and every array of the scene, forward
      and reverse; one-sided at the onset of contact and at Coulomb's limit, see ``contact.penalty_force``. With
      ``scene.stepper`` it is that of a converged step (implicit function theorem), up to its ``gradient_tolerance``,
      and NaN where the linear system is not solved. None through ``error``, ``filled`` and ``speed``.

    Raises:
      ValueError: poses, pins, grips or the state do not fit the scene; the state lacks creases or holds that the scene
        needs; ``store_every`` does not divide the number of substeps; state and scene differ in precision.
    """
    num_substeps, num_bodies = poses.position.shape[0] - 1, poses.position.shape[1]
    check_bodies(scene.colliders, num_bodies)
    check_precision(state.x, scene.gravity, poses.position)
    prescribed = checked_prescribed(scene, state, pins, grips, num_substeps, num_bodies)
    check_creases(scene.cloth, scene.topology, state.crease)
    intervals = Interval(both_ends(poses), prescribed)
    if scene.stepper is not None:
        return _implicit(scene, state, intervals, store_every)
    if state.crease is not None:
        return _creasing(scene, state, intervals, store_every)
    one = _substep if store_every is None else _recomputed_substep

    def body(vertices: Vertices, interval: Interval, pairs: AllPairs | None = None) -> Vertices:
        return one(scene, vertices, interval, pairs)

    end, seen = _scanned(scene, body, split(state), intervals, store_every)
    return remembered(state, join(end), seen).replace(error=state.error)


@checked(scene=SCENE, state=STATE, poses=poses("num_bodies"))
def open_grasps(scene: ThinScene, state: ThinState, poses: Pose) -> ThinState:
    """The state with all grasps open, given the poses of all bodies, shapes (num_bodies, 3), (num_bodies, 3, 3).

    Scenes with grasps begin with it. Gradient: exact.
    """
    check_vertices(scene, state)
    check_grasp_bodies(scene.grasps, poses.position.shape[0])
    return state.replace(holds=grasp_forces.open_holds(scene, state.x, poses))


@checked(scene=SCENE, state=STATE)
def internal_force(scene: ThinScene, state: ThinState) -> Array:
    """Elastic and damping forces on the vertices [N], shape (num_vertices, 3); they and their torques sum to zero.

    Without damping they are minus the gradient of ``elastic_energy``. Gradient: exact.
    """
    check_vertices(scene, state)
    x, v = split(state)[:2]
    return cp.join_vector(vertex_forces(creased(scene, state.crease), x, v))


@checked(scene=SCENE, state=STATE, before=poses("num_bodies"), after=poses("num_bodies"))
def contact_force(scene: ThinScene, state: ThinState, before: Pose, after: Pose) -> Array:
    """Forces of ground and colliders on the vertices [N], shape (num_vertices, 3), given the poses of all bodies at the
    beginning and end of a substep. Gradient: exact."""
    check_vertices(scene, state)
    check_bodies(scene.colliders, before.position.shape[0])
    return cp.join_vector(contact_forces(scene, *split(state)[:2], (before, after)))


def _implicit(scene: ThinScene, state: ThinState, intervals: Interval, store_every: int | None) -> ThinState:
    """``step`` by implicit substeps. Creases yield at the end of each."""
    bound = reach(scene)
    limit = None if state.crease is None else yield_angle(scene)

    def body(at: Solved, interval: Interval, pairs: AllPairs | None = None) -> Solved:
        now = creased(scene, at.crease)
        new = implicit_step(now, bound, Step(at.x, at.v, at.error), interval.poses, interval.prescribed.pins, pairs)
        crease = None if limit is None or at.crease is None else yielded(scene, limit, new.x, at.crease)
        return Solved(new.x, new.v, jnp.maximum(at.error, new.error), crease)

    start = Solved(*split(state)[:2], jnp.zeros((), state.x.dtype), state.crease)
    end, seen = _scanned(scene, body, start, intervals, store_every)
    after = remembered(state, join(Vertices(end.x, end.v)), seen)
    return after.replace(error=jax.lax.stop_gradient(end.error), crease=end.crease)


def _creasing(scene: ThinScene, state: ThinState, intervals: Interval, store_every: int | None) -> ThinState:
    """``step`` by explicit substeps of cloth that yields, each after its creases."""
    assert state.crease is not None
    limit = yield_angle(scene)
    one = _creased_substep if store_every is None else _recomputed_creased_substep

    def body(at: Creased, interval: Interval, pairs: AllPairs | None = None) -> Creased:
        return one(scene, limit, at, interval, pairs)

    end, seen = _scanned(scene, body, Creased(*split(state), state.crease), intervals, store_every)
    return remembered(state, join(Vertices(*end[:3])), seen).replace(error=state.error, crease=end.crease)


def _scanned(
    scene: ThinScene, body: Any, start: Any, intervals: Interval, store_every: int | None
) -> tuple[Any, Seen | None]:
    if scene.self_contact is None:
        return scan_substeps(body, start, intervals, store_every), None
    every = scene.self_contact.every
    return scan_rounds(body, lambda at: watched_pairs(scene, at), start, intervals, store_every, every)


# --- One substep, by components ---------------------------------------------------------------------------------------


def _substep(scene: ThinScene, vertices: Vertices, interval: Interval, pairs: AllPairs | None) -> Vertices:
    vertices, (pins, grips) = materialize(vertices), interval.prescribed
    x, v, holds = vertices
    with jax.named_scope("thin"):
        force = vertex_forces(scene, x, v)
    with jax.named_scope("contact"):
        contact = contact_forces(scene, x, v, interval.poses)
    if pairs is not None:
        with jax.named_scope("self_contact"):
            contact = cp.add(contact, self_forces(scene, x, v, pairs))
    if grips is not None:
        with jax.named_scope("grasps"):
            holds = grasp_forces.followed(scene, holds, x, interval.poses[0], grips)
            moving = grasp_forces.body_velocities(scene, x, interval.poses)
            for pull in grasp_forces.pulls(scene, holds, x, v, interval.poses[0], moving, grips):
                contact = cp.add(contact, pull.force)
    return moved(scene, Vertices(x, v, holds), force, contact, pins)


_recomputed_substep = recomputed(_substep)


def _creased_substep(
    scene: ThinScene, limit: Array, at: Creased, interval: Interval, pairs: AllPairs | None
) -> Creased:
    crease = yielded(scene, limit, at.x, at.crease)
    new = _substep(creased(scene, crease), Vertices(at.x, at.v, at.holds), interval, pairs)
    return Creased(*new, crease)


_recomputed_creased_substep = recomputed(_creased_substep)


def moved(scene: ThinScene, vertices: Vertices, force: Vec3, contact: Vec3, pins: Array | None) -> Vertices:
    """Vertices a substep later, given the internal and external forces [N] and the positions of held ones [m].

    Gradient: exact.
    """
    with jax.named_scope("update"):
        shared = (scene.gravity, scene.drag, scene.dt)
        target = None if pins is None else scatter(scene.topology.held, (cp.split_vector(pins),))
        given = (vertices._replace(holds=()), force, contact, scene.mass, scene.mobility, target)
        return _moved(shared, given)._replace(holds=vertices.holds)


@pointwise
def _moved(
    shared: tuple[Array, Scalar, Scalar], given: tuple[Vertices, Vec3, Vec3, Array, Array | None, Vec3 | None]
) -> Vertices:
    (g, drag, dt), ((x, v, _), force, contact, mass, mobility, target) = shared, given
    gain = 1.0 if mobility is None else mobility
    new = cp.vector(lambda i: v[i] + dt * gain * ((force[i] + contact[i]) / mass + g[i] - drag * v[i]))
    if target is None or mobility is None:
        return Vertices(cp.vector(lambda i: x[i] + dt * new[i]), new)
    new = cp.vector(lambda i: jnp.where(mobility > 0, new[i], (target[i] - x[i]) / dt))
    return Vertices(cp.vector(lambda i: jnp.where(mobility > 0, x[i] + dt * new[i], target[i])), new)


def vertex_forces(scene: ThinScene, x: Vec3, v: Vec3) -> Vec3:
    """``internal_force`` by components."""
    topology, rest, forces = scene.topology, scene.rest, []
    if scene.cloth is not None:
        sizes = (inverse_edges(scene), rest.area)
        forces.append(elements.membrane_force(scene.cloth, scene.law, topology.triangles, x, v, *sizes))
        if len(topology.hinges):
            forces.append(bending_forces(scene, x, v))
    if scene.rope is not None:
        forces.append(elements.segment_force(scene.rope, topology.segments, x, v, rest.length))
        if len(topology.bends):
            forces.append(elements.bend_force(scene.rope.bending, topology.bends, x, rest.bend_length))
    return functools.reduce(cp.add, forces)


def contact_forces(scene: ThinScene, x: Vec3, v: Vec3, poses: tuple[Pose, Pose]) -> Vec3:
    """``contact_force`` by components."""
    nothing = cp.vector(lambda i: jnp.zeros_like(x[i]))
    if scene.contact is None:
        return nothing
    forces = [] if scene.ground is None else [ground_force(scene.ground, scene.contact, x, v)]
    for collider in scene.colliders:
        start, end = (body_pose(pose, collider.body) for pose in poses)
        forces.append(collider_force(collider, scene.contact, x, v, start, end, scene.dt))
    return functools.reduce(cp.add, forces) if forces else nothing


def split(state: ThinState) -> Vertices:
    """Components of a state."""
    return Vertices(cp.split_vector(state.x), cp.split_vector(state.v), grasp_forces.split_holds(state.holds))


def join(vertices: Vertices) -> ThinState:
    """Inverse of ``split``. The state has no error of implicit steps, no creases and no memory of self-contact."""
    nothing = jnp.zeros_like(vertices.x[0][0])
    return ThinState(
        x=cp.join_vector(vertices.x),
        v=cp.join_vector(vertices.v),
        holds=grasp_forces.join_holds(vertices.holds),
        error=nothing,
        filled=nothing,
        speed=nothing,
    )


def remembered(before: ThinState, after: ThinState, seen: Seen | None) -> ThinState:
    """The state after a step, with the extremes of self-contact of all steps. Gradient: none."""
    known = [before.filled, before.speed]
    if seen is not None:
        known = [jnp.maximum(old, new) for old, new in zip(known, seen, strict=True)]
    filled, speed = jax.lax.stop_gradient(known)
    return after.replace(filled=filled, speed=speed)


@checked(scene=SCENE, state=STATE)
def self_contact_force(scene: ThinScene, state: ThinState) -> Array:
    """Forces of self-contact on the vertices [N], shape (num_vertices, 3). They sum to zero; their torques do without
    friction.

    Gradient: exact.
    """
    check_vertices(scene, state)
    x, v, _ = split(state)
    if scene.self_contact is None:
        return jnp.zeros_like(state.x)
    return cp.join_vector(self_forces(scene, x, v, close_pairs(scene, x)))


__all__ = [
    "contact_force", "internal_force", "moved", "open_grasps", "remembered", "self_contact_force",
    "step",
]  # fmt: skip
