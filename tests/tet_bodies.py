"""A soft block of ten tetrahedra, its scenes and states, for tests of tetrahedra."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import tets
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.pose import static_poses
from rewax.physics.tets import tetmesh
from rewax.physics.tets.law import DampingLaw
from rewax.physics.tets.stepping import TetState

MESH = tetmesh.box((0.4, 0.2, 0.2), (2, 1, 1), tets_per_cell=5)
NUM_TETS, NUM_VERTICES = 10, 12
STEP = jax.jit(tets.step, static_argnames="store_every")
"""Compiled once for each structure of a scene and number of substeps: tests share these."""
MANY = 1000


def body(mesh=MESH, **changes):
    """A soft block at rest and its scene; parameters per tet, so that all of them share compiled programs."""
    settings = dict(
        mesh=mesh, density=1000.0, mu=4e4, lam=6e4, dt=5e-4, gravity=(0.0, 0.0, 0.0), damping=0.0, activation=0.0,
        damping_law=DampingLaw.STRAIN_RATE,
    )  # fmt: skip
    scene = jax.tree.map(lambda a: jnp.asarray(a, float), tets.make_scene(**(settings | changes)))
    per_tet = {
        name: jnp.broadcast_to(getattr(scene, name), NUM_TETS) for name in ("mu", "lam", "damping", "activation")
    }
    return scene.replace(**per_tet), tets.initial_state(mesh.vertices)


def shaken(state, size=0.02, speed=1.0, seed=0):
    """Vertices moved and moving at random."""
    rng = np.random.default_rng(seed)
    x, v = size * rng.standard_normal(state.x.shape), speed * rng.standard_normal(state.x.shape)
    return TetState(x=state.x + jnp.asarray(x, state.x.dtype), v=jnp.asarray(v, state.x.dtype))


def run(scene, state, num_substeps=MANY):
    return STEP(scene, state, static_poses(num_substeps, dtype=state.x.dtype))


def spin_matrix(omega):
    return np.array([[0, -omega[2], omega[1]], [omega[2], 0, -omega[0]], [-omega[1], omega[0], 0]])


def deformed(kind, state, rotations):
    return {
        "rest": state.x,
        "turned": state.x @ rotations(1, 1)[0].T + jnp.array([1.0, 2.0, 3.0]),
        "flat": state.x * jnp.array([1.0, 0.0, 1.0]),
        "a point": state.x * 0.0,
        "inverted": state.x * jnp.array([1.0, -0.7, 1.0]),
        "shaken": shaken(state, 0.1).x,
    }[kind]


KINDS = ["rest", "turned", "flat", "a point", "inverted", "shaken"]


def at_rest(num_bodies=0):
    poses = static_poses(1, num_bodies, jnp.float64)
    return tuple(jax.tree.map(lambda p, t=t: p[t], poses) for t in (0, 1))


CONTACT = PenaltyContact(stiffness=2e4, damping=20.0, friction_damping=200.0, friction=0.5, radius=0.02)
FLOOR = Ground(normal=np.array([0.0, 1.0, 0.0]), height=-0.12)
