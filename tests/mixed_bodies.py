"""Sand and cloth in contact, for tests of both together."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import coupling, mpm, thin
from rewax.physics.mpm import DruckerPrager, Grid, Hencky, Material
from rewax.physics.numerics import components as cp
from rewax.physics.thin import closest

SPACING = 6.25e-3
"""Of the particles [m]; two per cell and axis."""
RUN = jax.jit(coupling.step_prescribed, static_argnames="store_every")


def sand_scene(dt=1e-4, **changes):
    material = Material(
        density=1500.0,
        elasticity=Hencky(youngs_modulus=2e4, poissons_ratio=0.3),
        plasticity=DruckerPrager(friction_angle=0.5, cohesion=0.0),
    )
    grid = Grid(shape=(24, 24, 24), spacing=2 * SPACING, origin=(-0.15, -0.1, -0.15))
    return mpm.make_scene(**({"grid": grid, "dt": dt, "material": material, "particle_volume": SPACING**3} | changes))


def bag_mesh(cells=10, width=0.2, depth=0.06):
    """A square bag, its rim at the height 0: (mesh, indices of the rim)."""
    sheet = thin.sheet(width, width, cells, cells)
    x = np.array(sheet.vertices) - [width / 2, 0.0, width / 2]
    outward = np.abs(x[:, [0, 2]]).max(axis=-1) / (width / 2)
    x[:, 1] = depth * (np.maximum(outward - 0.4, 0.0) / 0.6 - 1.0)
    return thin.ThinMesh(vertices=x, triangles=sheet.triangles), np.flatnonzero(outward > 0.99)


def cloth_scene(mesh, dt=1e-4, **changes):
    cloth = thin.isotropic_cloth(youngs_modulus=2e5, poissons_ratio=0.3, thickness=1e-3, density=300.0, damping=1e-4)
    return thin.make_scene(**({"mesh": mesh, "dt": dt, "cloth": cloth} | changes))


def law_of(**changes):
    numbers = {"thickness": 4e-3, "stiffness": 200.0, "damping": 0.01, "friction": 0.4, "friction_damping": 0.01}
    return coupling.ParticleContact(**(numbers | {"max_speed": 0.9, "pairs_per_particle": 12} | changes))


def both(mesh, grains, *, particles=None, thin_scene=None, **law):
    """A mixed scene and its state at rest."""
    particles, thin_scene = particles or sand_scene(), thin_scene or cloth_scene(mesh)
    scene = coupling.make_mixed_scene(
        particles=particles, thin=thin_scene, contact=law_of(**law), vertices=mesh.vertices
    )
    state = coupling.MixedState(
        particles=mpm.initial_state(jnp.asarray(grains, float), particles), thin=thin.initial_state(mesh.vertices)
    )
    return scene, state


def side(grains, x, triangles):
    """Signed distance of each particle from the cloth, positive on the side of the normals."""
    corners = [np.asarray(x)[np.asarray(triangles)[:, k]] for k in range(3)]
    arrays = np.broadcast_arrays(np.asarray(grains)[:, None], *(c[None] for c in corners))
    own = tuple(tuple(a[..., i] for i in range(3)) for a in arrays)
    between = cp.join_vector(closest.weighted(closest.vertex_triangle(own), own))
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    gap = np.linalg.norm(between, axis=-1)
    nearest = gap.argmin(axis=1)
    rows = np.arange(len(grains))
    return gap[rows, nearest] * np.sign(np.einsum("ni,ni->n", np.asarray(between)[rows, nearest], normal[nearest]))
