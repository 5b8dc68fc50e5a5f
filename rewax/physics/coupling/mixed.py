"""Particles and cloth together, in contact with each other: sand in a bag, water on a towel.

``mixed_contact`` has their substep.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from rewax import struct
from rewax.physics.coupling.particle_contact import (
    ParticleContact,
    largest_depth,
    meeting_speed,
    particle_pairs,
    stopping_energy,
)
from rewax.physics.coupling.triangle_tree import TriangleTree
from rewax.physics.mpm import stepping as mpm_stepping
from rewax.physics.mpm.scene import MPMScene, MPMState, check_state, materials_of, particle_mass
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, any_illegal, check_numbers
from rewax.physics.numerics.fields import check_fields, checked, instance, optional, real
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin import thin_status
from rewax.physics.thin.grasps import Grasp
from rewax.physics.thin.scene import ThinScene, ThinState, check_vertices
from rewax.physics.thin.stable_dt import STABLE_FRACTION, largest_stable_dt
from rewax.status import Status, flag
from rewax.types import Array, Scalar, Vector

LAYERS = 8
"""Layers of particles that press on the one in front, for ``largest_safe_particle_speed``."""
DEEPEST = 0.9
"""Depth over thickness beyond which a particle is all but through the cloth, and nothing more holds it back."""
EXTREMES = ("full", "missed", "speed", "depth")
"""Numbers of a ``MixedState`` that are the largest of all steps."""
CROWD = 2
"""Pairs of one particle, and sides of the cloth with particles, for which the stable dt has room."""
_SCENE = {
    "particles": instance(MPMScene, "give a scene of mpm.make_scene"),
    "thin": instance(ThinScene, "give a scene of thin.make_scene"),
    "contact": instance(ParticleContact, "give a ParticleContact(thickness=..., stiffness=...)"),
    "vertices": real(FINITE, "give positions in metres, such as those of the mesh", shape=("num_vertices", 3)),
}


@struct.dataclass
class MixedState(struct.Replaceable):
    """Particles and vertices.

    Attributes:
      particles: state of ``mpm.initial_state``.
      thin: state of ``thin.initial_state``.
      full: 1 if the list of close particles and triangles has been too short in any step, else 0, shape (). Gradient:
        none.
      missed: 1 if particles have reached nodes of the grid outside of their list in any step, else 0, shape ().
        Gradient: none.
      speed: largest speed at which a particle may have met the cloth in any step [m/s], shape (). Gradient: none.
      depth: largest depth of a particle in the cloth's thickness in any step [-], shape (): 0 where they touch, 1 at
        the middle. Gradient: none.
    """

    particles: MPMState
    thin: ThinState
    full: Scalar = struct.number(NOT_NEGATIVE, "give 0", shape=(), default=0.0)
    missed: Scalar = struct.number(NOT_NEGATIVE, "give 0", shape=(), default=0.0)
    speed: Scalar = struct.number(NOT_NEGATIVE, "give 0", shape=(), default=0.0)
    depth: Scalar = struct.number(NOT_NEGATIVE, "give 0", shape=(), default=0.0)

    def __post_init__(self) -> None:
        # The types of a step's result: a weak one would compile the next step again.
        for name in EXTREMES:
            value = getattr(self, name)
            if getattr(value, "weak_type", False):
                object.__setattr__(self, name, jnp.asarray(value, value.dtype))

    @property
    def x(self) -> Array:
        """Positions of the particles [m], shape (num_particles, 3)."""
        return self.particles.x


@struct.dataclass
class MixedScene(struct.Replaceable):
    """Particles, cloth and their contact; build it with ``make_mixed_scene``, which checks it.

    Attributes:
      particles: scene of the particles.
      thin: scene of the cloth.
      contact: law of contact between them.
      tree: the cloth's triangles (static).
    """

    particles: MPMScene
    thin: ThinScene
    contact: ParticleContact
    tree: TriangleTree = struct.static_field()

    @property
    def dt(self) -> float:
        """Duration of a substep [s]."""
        return self.thin.dt

    @property
    def gravity(self) -> Vector:
        """Acceleration of the particles [m/s^2], shape (3,)."""
        return self.particles.gravity

    @property
    def colliders(self) -> tuple:
        """Colliders of particles, then those of cloth."""
        return (*self.particles.colliders, *self.thin.colliders)

    @property
    def grasps(self) -> tuple[Grasp, ...]:
        """Grasps of the cloth."""
        return self.thin.grasps


def make_mixed_scene(*, particles: MPMScene, thin: ThinScene, contact: ParticleContact, vertices: Any) -> MixedScene:
    """A checked ``MixedScene``.

    Args:
      particles, thin, contact: the fields of ``MixedScene``. Both scenes have the same dt.
      vertices: positions of the vertices at rest [m], shape (num_vertices, 3): ``mesh.vertices``.

    Raises:
      ValueError: scenes of different dt, a scene without triangles, an illegal number, a dt above
        ``largest_stable_mixed_dt``, or a ``max_speed`` above ``largest_safe_particle_speed``.
    """
    check_fields(_SCENE, locals())
    check_numbers(contact.legal_numbers("contact"))
    if particles.dt != thin.dt:
        raise ValueError(
            f"particles.dt is {particles.dt:g} s and thin.dt {thin.dt:g} s: give both scenes the smaller one"
        )
    if not len(thin.topology.triangles):
        raise ValueError("thin has no triangles, and particles touch triangles alone: give it a mesh of a cloth")
    if len(vertices) != len(thin.mass):
        raise ValueError(f"vertices has {len(vertices)} rows: give one for each of the {len(thin.mass)} vertices")
    tree = TriangleTree(thin.topology.triangles.indices, vertices)
    scene = MixedScene(particles=particles, thin=thin, contact=contact, tree=tree)
    limits = _limits(scene)
    if any(isinstance(a, Tracer) for a in (*limits, contact.max_speed)):
        return scene
    if scene.dt > float(limits[0]):
        raise ValueError(
            f"dt is {scene.dt:g} s, above the largest stable {float(limits[0]):.3g} s of cloth and particles in "
            "contact: take more substeps of smaller dt, or a softer contact"
        )
    if float(contact.max_speed) > float(limits[1]):
        raise ValueError(
            f"contact.max_speed is {float(contact.max_speed):g} m/s, above {float(limits[1]):.3g} m/s, up to which "
            "the cloth keeps particles back: take a smaller max_speed, or a stiffer or thicker contact"
        )
    return scene


@jax.jit  # operation by operation, XLA would compile hundreds of programs
def _limits(scene: MixedScene) -> tuple[Scalar, Scalar]:
    return largest_stable_mixed_dt(scene), largest_safe_particle_speed(scene)


def largest_safe_particle_speed(scene: MixedScene) -> Scalar:
    """Speed of particles relative to the cloth [m/s] up to which they do not pass through.

    It is the smaller of two limits:
      - sqrt(2 E / (8 m)): a particle of the largest mass m must bring the energy E to reach the cloth's middle, and 8
        layers of particles press with the kinetic energy of their common speed.
      - thickness / (4 dt): in a substep a particle comes closer by at most a quarter of the thickness.

    Gradient: exact.
    """
    mass = jnp.max(_masses(scene))
    energy = stopping_energy(scene.contact)
    return jnp.minimum(jnp.sqrt(2.0 * energy / (LAYERS * mass)), scene.contact.thickness / (4.0 * scene.dt))


def largest_stable_mixed_dt(scene: MixedScene) -> Scalar:
    """Largest substep [s] at which cloth and particles at rest in contact stay stable.

    Stiffness adds to that of ``thin.largest_stable_dt``. A particle has up to two pairs. A vertex carries the particles
    of its third of the triangles, one for each particle_volume^(2/3), on both sides of the cloth. It does not
    include ``mpm.largest_stable_dt``.

    Gradient: exact.
    """
    thin, law = scene.thin, scene.contact
    mass = jnp.min(_masses(scene))
    area = jnp.zeros_like(thin.mass).at[scene.tree.triangles].add((thin.rest.area / 3.0)[:, None])
    carried = jnp.maximum(area / jnp.min(scene.particles.particle_volume) ** (2.0 / 3.0), 1.0)
    # Gershgorin: a row of the stiffness matrix has the sum of its pairs' weights twice.
    ratio = 2.0 * CROWD * jnp.maximum(1.0 / mass, jnp.max(carried / thin.mass))
    w2, c = law.stiffness * ratio, law.damping * ratio
    limit = STABLE_FRACTION * 4.0 / (c + jnp.sqrt(c * c + 4.0 * w2))
    return 1.0 / jnp.sqrt(1.0 / largest_stable_dt(thin) ** 2 + 1.0 / limit**2)


def _masses(scene: MixedScene) -> Array:
    """Masses of the particles [kg]; one if all are equal."""
    particles = scene.particles
    if particles.particle_counts is None:
        count = max(jnp.size(a) for a in (particles.particle_volume, *(m.density for m in materials_of(particles))))
    else:
        count = sum(particles.particle_counts)
    return particle_mass(particles, jnp.zeros(count, scene.thin.mass.dtype))


SCENE = instance(MixedScene, "give a scene of make_mixed_scene")
STATE = instance(MixedState, "give a MixedState(particles=..., thin=...)")


@checked(scene=SCENE, state=STATE, poses=optional(instance(Pose, "give a Pose, or None")))
def check_status(scene: MixedScene, state: MixedState, *, poses: Pose | None = None) -> Array:
    """Status bits of particles and cloth, and of their contact.

    Besides those of ``mpm.check_status`` and ``thin.check_status``, remembered from all steps so far:

    - ``FULL_PAIRS``: the list of close particles and triangles was full.
    - ``CROSSED``: a particle may meet the cloth faster than ``contact.max_speed`` or ``largest_safe_particle_speed``,
      or was pressed through nine tenths of the contact's thickness.
    - ``INACTIVE_NODES``: the list of nodes was too short, or a particle moved too far between two searches.

    Args:
      scene: the scene.
      state: particles and vertices at the end of a step.
      poses: poses of its bodies, shapes (num_substeps + 1, num_bodies, ...), as for ``mpm.check_status``.

    Returns:
      Bits of ``rewax.status.Status``, shape (), int32. Gradient: none.
    """
    check_state(scene.particles, state.particles)
    check_vertices(scene.thin, state.thin)
    scene, state = jax.lax.stop_gradient((scene, state))
    particles, vertices = ((cp.split_vector(s.x), cp.split_vector(s.v)) for s in (state.particles, state.thin))
    pairs = particle_pairs(scene.contact, scene.tree, scene.dt, particles[0], vertices[0])
    speed = meeting_speed(scene.contact, pairs, scene.dt, particles, vertices)
    # A scene that was changed after it was built may be safe only at lower speeds.
    limit = jnp.minimum(scene.contact.max_speed, (1.0 + 1e-5) * largest_safe_particle_speed(scene))
    fast = jnp.maximum(state.speed, speed) > limit
    deep = jnp.maximum(state.depth, largest_depth(pairs, particles, vertices)) > DEEPEST
    last = None if poses is None else Pose(*(a[-1] for a in poses))
    bad = any_illegal(scene.contact.legal_numbers("contact"))
    too_long = ~(scene.dt <= (1.0 + 1e-5) * largest_stable_mixed_dt(scene))
    # A coupled step evaluates all colliders, and remembers whether the nodes sufficed.
    grid = scene.particles.replace(max_near_colliders=None, max_active_nodes=None)
    missed = mpm_stepping.nodes_missed(scene.particles, state.particles.x, state.particles.x)
    return (
        mpm_stepping.check_status(grid, state.particles, poses=poses)
        | thin_status.check_status(scene.thin, state.thin, poses=last)
        | flag((state.full > 0) | pairs.full, Status.FULL_PAIRS)
        | flag((state.missed > 0) | missed, Status.INACTIVE_NODES)
        | flag(fast | deep, Status.CROSSED)
        | flag(bad | too_long, Status.INVALID_PARAMETERS)
    )


__all__ = [
    "MixedScene", "MixedState", "check_status", "largest_safe_particle_speed", "largest_stable_mixed_dt",
    "make_mixed_scene",
]  # fmt: skip
