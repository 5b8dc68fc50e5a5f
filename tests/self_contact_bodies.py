"""Small bodies in contact with themselves, and a referee that counts crossings, for tests of self-contact."""

import jax
import numpy as np
from thin_bodies import cloth_scene, rope_scene, shaken

from rewax.physics import thin

FORCE = jax.jit(thin.self_contact_force)
RUN = jax.jit(thin.step, static_argnames="store_every")
FLOOR = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.3, 0.0, 0.0]]


def law(**changes):
    """Built in the test, so that its numbers have the test's precision."""
    given = {"thickness": 0.02, "stiffness": 50.0, "damping": 0.05, "friction": 0.4, "friction_damping": 0.05}
    return thin.SelfContact(**given | {"max_speed": 0.5, "every": 4} | changes)


def two(points, kind):
    """A triangle with another above it, or two ropes of one segment."""
    points = np.asarray(points, float)
    if kind == "cloth":
        mesh = thin.ThinMesh(vertices=points, triangles=np.asarray([[0, 1, 2], [3, 4, 5]], np.int32))
        return cloth_scene(mesh, dt=1e-5, self_contact=law(max_speed=0.1))
    mesh = thin.ThinMesh(vertices=points, segments=np.asarray([[0, 1], [2, 3]], np.int32))
    return rope_scene(mesh, dt=1e-5, self_contact=law(max_speed=0.1))


def folded(seed=0, size=0.001, **changes):
    """A sheet folded on itself with its halves within the thickness, shaken."""
    mesh = thin.sheet(0.4, 0.2, 8, 4)
    x = np.array(mesh.vertices)
    back = x[:, 0] > 0.21
    x[back] = np.stack([0.40155 - x[back, 0], np.full(back.sum(), 0.012), x[back, 2] + 0.003], axis=-1)
    state = shaken(mesh, size=size, speed=0.1, seed=seed)
    scene = cloth_scene(mesh, dt=1e-4, self_contact=law(thickness=0.015, **changes))
    limp = scene.replace(cloth=scene.cloth.replace(bending=1e-6))  # else the fold springs open
    return limp, state.replace(x=state.x - mesh.vertices + x)


def crossings(mesh, x):
    """Number of edges that pass through a triangle with which they share no vertex, in NumPy: all pairs."""
    edges = np.unique(np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    i, j = (k.reshape(-1) for k in np.indices((len(edges), len(mesh.triangles))))
    apart = ~(edges[i][:, :, None] == mesh.triangles[j][:, None, :]).any(axis=(1, 2))
    (p, q), (a, b, c) = x[edges[i[apart]]].swapaxes(0, 1), x[mesh.triangles[j[apart]]].swapaxes(0, 1)

    def volume(u, v, w, z):
        return np.einsum("na,na->n", np.cross(v - u, w - u), z - u)

    around = np.stack([volume(p, q, *pair) for pair in ((a, b), (b, c), (c, a))])
    through = (around > 0).all(axis=0) | (around < 0).all(axis=0)
    return int(np.sum(through & (volume(a, b, c, p) * volume(a, b, c, q) < 0)))
