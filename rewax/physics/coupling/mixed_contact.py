"""The substep of particles and cloth together, for ``soft.Solver``.

Both advance with one dt. The forces between them act at the substep's beginning: on the particles as impulses
before their momentum goes to the grid (P2G), on the vertices beside the cloth's own forces. Then each meets colliders,
walls and grasps as it does alone.

The grid does not see the cloth. Particles on both sides of a cloth that are closer than about 1.5 cells feel each
other's stress.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp

from rewax.physics.contact.motion import Motion
from rewax.physics.coupling import nodes, sheets
from rewax.physics.coupling.exchange import Received, System
from rewax.physics.coupling.mixed import EXTREMES, MixedScene, MixedState
from rewax.physics.coupling.nodes import NodeContact
from rewax.physics.coupling.particle_contact import (
    ParticlePairs,
    contact_forces,
    largest_depth,
    meeting_speed,
    particle_pairs,
)
from rewax.physics.coupling.vertices import VertexContact
from rewax.physics.mpm.active_nodes import ActiveNodes
from rewax.physics.mpm.packing import join as join_particles
from rewax.physics.mpm.packing import split as split_particles
from rewax.physics.mpm.packing import unpack
from rewax.physics.mpm.scene import particle_mass
from rewax.physics.mpm.stepping import nodes_missed, nodes_of_step
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin import stepping as thin_stepping
from rewax.physics.thin.prescribed import NOTHING_PRESCRIBED, Prescribed
from rewax.physics.thin.self_contact import AllPairs, Seen, watched_pairs
from rewax.physics.thin.stepping import Vertices
from rewax.types import Array


class Mixed(NamedTuple):
    """``MixedState`` by components, for the inner loop."""

    particles: Array
    vertices: Vertices

    @property
    def x(self) -> Vec3:
        """Positions of the vertices [m]."""
        return self.vertices.x


class Constants(NamedTuple):
    """Values that several substeps share."""

    nodes: ActiveNodes | None = None
    """Nodes of the grid in reach of the particles."""
    own: AllPairs | None = None
    """Pairs of the cloth's self-contact."""
    pairs: ParticlePairs | None = None
    """Pairs of particles and triangles."""


class Met(NamedTuple):
    """Result of a search; ``remembered`` keeps the extremes. Gradient: none."""

    own: Seen | None
    """Extremes of the cloth's self-contact."""
    full: Array
    """Whether the list of particles and triangles was full, shape (), bool."""
    missed: Array
    """Whether particles reached nodes outside of their list, shape (), bool."""
    speed: Array
    """Largest speed of a particle relative to the cloth that it may meet [m/s], shape ()."""
    depth: Array
    """Largest depth of a particle in the cloth's thickness [-], shape ()."""


class MixedContact(NamedTuple):
    """Nodes of the grid and vertices in the middle of a substep, see ``exchange.SoftContact``. Gradient: exact."""

    particles: NodeContact
    cloth: VertexContact

    def meet(self, poses: Pose, now: Sequence[Motion], before: Callable[[], Sequence[Motion]]) -> Self:
        return self._replace(
            particles=self.particles.meet(poses, now, before), cloth=self.cloth.meet(poses, now, before)
        )

    def system(self, body: int, origin: Array) -> System:
        both = self.particles.system(body, origin), self.cloth.system(body, origin)
        return System(*(a + b for a, b in zip(*both, strict=True)))

    def exchange(self, motions: Sequence[Motion | None], origins: Array) -> tuple[Self, Received]:
        particles, first = self.particles.exchange(motions, origins)
        cloth, second = self.cloth.exchange(motions, origins)
        total = Received(first.impulse + second.impulse, first.moment + second.moment)
        return self._replace(particles=particles, cloth=cloth), total

    def finish(self) -> Mixed:
        return Mixed(self.particles.finish(), self.cloth.finish())

    def given(self) -> tuple[Vec3, list[tuple[int, Vec3]]]:
        (first, of_nodes), (second, of_vertices) = self.particles.given(), self.cloth.given()
        before, behind = jnp.zeros_like(first[0]), jnp.zeros_like(second[0])
        every = [(b, cp.vector(lambda i, f=f: jnp.concatenate([f[i], behind]))) for b, f in of_nodes]
        every += [(b, cp.vector(lambda i, f=f: jnp.concatenate([before, f[i]]))) for b, f in of_vertices]
        return cp.vector(lambda i: jnp.concatenate([first[i], second[i]])), every


def split(state: MixedState) -> Mixed:
    """Components of a state."""
    return Mixed(split_particles(state.particles), thin_stepping.split(state.thin))


def join(soft: Mixed) -> MixedState:
    """Inverse of ``split``."""
    particles, thin = join_particles(soft.particles), thin_stepping.join(soft.vertices)
    nothing = jnp.zeros((), thin.x.dtype)
    return MixedState(particles=particles, thin=thin, speed=nothing, depth=nothing)


def constants_of(scene: MixedScene, state: MixedState) -> Constants:
    """None: ``search`` finds all that substeps share."""
    del scene, state
    return Constants()


def every_of(scene: MixedScene) -> int:
    """Substeps between two searches for close pairs and the particles' nodes."""
    own = scene.thin.self_contact
    return scene.contact.every if own is None else min(own.every, scene.contact.every)


def search(scene: MixedScene, constants: Constants, soft: Mixed) -> tuple[Constants, Callable[[Mixed, int], Met]]:
    """The pairs that are close now and the nodes in reach, and ``(end, substeps) -> met`` for the round that begins."""
    vertices, particles = soft.vertices, unpack(soft.particles)
    own, watch = (None, None) if scene.thin.self_contact is None else watched_pairs(scene.thin, vertices)
    pairs = particle_pairs(scene.contact, scene.tree, scene.dt, particles.x, vertices.x)
    both = (particles.x, particles.v), (vertices.x, vertices.v)
    fast, deep = meeting_speed(scene.contact, pairs, scene.dt, *both), largest_depth(pairs, *both)
    start = jnp.stack(particles.x, axis=-1)

    def met(end: Mixed, substeps: int) -> Met:
        missed = nodes_missed(scene.particles, start, jnp.stack(unpack(end.particles).x, axis=-1))
        return Met(None if watch is None else watch(end.vertices, substeps), pairs.full, missed, fast, deep)

    nodes = nodes_of_step(scene.particles, start)
    return constants._replace(nodes=nodes, own=own, pairs=pairs), met


def remembered(before: MixedState, after: MixedState, met: Met) -> MixedState:
    """The state after a step, with the extremes of contact of all steps. Gradient: none."""
    extremes = {}
    for name in EXTREMES:
        old = getattr(before, name)
        extremes[name] = jax.lax.stop_gradient(jnp.maximum(old, getattr(met, name).astype(jnp.result_type(old))))
    own = thin_stepping.remembered(before.thin, after.thin, met.own)
    return after.replace(thin=own, **extremes)


def begin(
    scene: MixedScene, constants: Constants, soft: Mixed, prescribed: Prescribed = NOTHING_PRESCRIBED
) -> MixedContact:
    """First part of a substep: forces between particles and cloth, then what each does alone. Gradient: exact."""
    packed, vertices = soft
    assert constants.nodes is not None and constants.pairs is not None
    p = unpack(packed)
    with jax.named_scope("particle_contact"):
        on_particles, on_vertices = contact_forces(scene.contact, constants.pairs, (p.x, p.v), (vertices.x, vertices.v))
    gain = scene.dt / particle_mass(scene.particles, packed[0])
    pushed = packed.at[3:6].add(jnp.stack(cp.scale(gain, on_particles)))
    return MixedContact(
        nodes.begin(scene.particles, constants.nodes, pushed),
        sheets.begin(scene.thin, constants.own, vertices, prescribed, on_vertices),
    )


__all__ = [
    "Constants", "Met", "Mixed", "MixedContact", "begin", "constants_of", "every_of", "join", "remembered", "search",
    "split",
]  # fmt: skip
