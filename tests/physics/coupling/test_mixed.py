"""Sand and cloth together: nothing escapes, nothing is lost, exact gradients, refusals, status."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import coupling, mpm, thin
from rewax.physics.contact import Collider, PenaltyContact
from rewax.physics.coupling import free_body, mixed
from rewax.physics.mpm import DruckerPrager, Grid, Hencky, Material, invariants
from rewax.physics.numerics import components as cp
from rewax.physics.shapes import Sphere, fill_box
from rewax.physics.thin import closest
from rewax.status import Status

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


def test_500_particles_of_sand_stay_in_a_held_bag_for_half_a_second():
    """They fall from 2 cm above into the bag, and hop as it gives way."""
    mesh, rim = bag_mesh()
    grains = fill_box((0.0, -0.01, 0.0), (0.05, 0.05, 0.05), SPACING)
    assert len(grains) >= 500
    scene, state = both(mesh, grains, thin_scene=cloth_scene(mesh, held=rim, drag=5.0))
    up = np.sign(side([[0.0, 0.0, 0.0]], mesh.vertices, mesh.triangles))
    for _ in range(10):
        state = RUN(scene, state, coupling.static_poses(500), store_every=None)
        assert (up * side(state.particles.x, state.thin.x, mesh.triangles)).min() > 0.0
        assert not int(mixed.check_status(scene, state)) & (Status.NAN | Status.CROSSED | Status.FULL_PAIRS)
    x = np.asarray(state.particles.x)
    assert np.abs(x[:, [0, 2]]).max() < 0.1 and x[:, 1].max() < 0.02  # none over the rim
    np.testing.assert_array_less(np.asarray(state.thin.x)[:, 1].min(), -0.06)  # their weight draws the bag down


def thrown(times):
    """Smallest height of eight layers of sand, thrown at a held sheet at a multiple of the largest safe speed."""
    mesh = thin.ThinMesh(vertices=thin.sheet(0.1, 0.1, 5, 5).vertices - [0.05, 0.0, 0.05],
                         triangles=thin.sheet(0.1, 0.1, 5, 5).triangles)  # fmt: skip
    grains = fill_box((0.0, 0.03, 0.0), (0.03, 8 * SPACING, 0.03), SPACING)
    scene, state = both(mesh, grains, thin_scene=cloth_scene(mesh, held=range(36)), damping=0.0)
    speed = times * mixed.largest_safe_particle_speed(scene)
    state = state.replace(particles=state.particles.replace(v=state.particles.v.at[:, 1].set(-speed)))
    seen = int(mixed.check_status(scene, state.replace(particles=state.particles.replace(
        x=state.particles.x - jnp.array([0.0, float(state.particles.x[:, 1].min()) - 3e-3, 0.0])))))  # fmt: skip
    lowest = []
    for _ in range(4):
        state = RUN(scene, state, coupling.static_poses(100), store_every=None)
        lowest.append(float(state.particles.x[:, 1].min()))
    return min(lowest), bool(seen & Status.CROSSED)


@pytest.mark.slow
def test_sand_does_not_pass_at_the_safe_speed_and_does_far_beyond():
    lowest, seen = thrown(0.97)
    assert lowest > 0.0 and not seen
    lowest, seen = thrown(8.0)
    assert lowest < 0.0 and seen


def touching(**changes):
    """A cloth, free to move, and a ball of sand in contact with it that fly towards each other."""
    mesh = thin.ThinMesh(vertices=thin.sheet(0.1, 0.1, 4, 4).vertices - [0.05, 0.0, 0.05],
                         triangles=thin.sheet(0.1, 0.1, 4, 4).triangles)  # fmt: skip
    particles = sand_scene(gravity=(0.0, 0.0, 0.0))
    cloth = cloth_scene(mesh, gravity=(0.0, 0.0, 0.0), **changes)
    grains = fill_box((0.003, 0.0125, 0.002), (0.03, 0.025, 0.03), SPACING)
    scene, state = both(mesh, grains, particles=particles, thin_scene=cloth)
    rng = np.random.default_rng(0)
    noise = [0.02 * rng.standard_normal(a.shape) for a in (state.particles.v, state.thin.v)]
    return scene, state.replace(
        particles=state.particles.replace(v=jnp.asarray(noise[0]) + jnp.array([0.1, -0.5, 0.0])),
        thin=state.thin.replace(v=jnp.asarray(noise[1])),
    )


def test_momentum_is_conserved_to_rounding(x64):
    scene, state = touching()
    scene = scene.replace(contact=scene.contact.replace(friction=jnp.zeros(())))  # whose forces have a torque

    def totals(state):
        p, t = (scene.particles, state.particles), (scene.thin, state.thin)
        return invariants.momentum(*p) + thin.momentum(*t), invariants.angular_momentum(*p) + thin.angular_momentum(*t)

    end = RUN(scene, state, coupling.static_poses(80, dtype=float))
    moved = float(jnp.abs(thin.momentum(scene.thin, end.thin) - thin.momentum(scene.thin, state.thin)).max())
    assert moved > 1e-4
    linear, angular = zip(totals(end), totals(state), strict=True)
    np.testing.assert_allclose(*linear, atol=1e-12 * moved)
    np.testing.assert_allclose(*angular, atol=1e-12 * moved)


def test_far_apart_each_moves_as_alone(x64):
    mesh, rim = bag_mesh(4)
    grains = fill_box((0.0, 0.05, 0.0), (0.03, 0.03, 0.03), SPACING)
    scene, state = both(mesh, grains, thin_scene=cloth_scene(mesh, held=rim))
    end = RUN(scene, state, coupling.static_poses(40, dtype=float))
    sand = jax.jit(mpm.step)(scene.particles, state.particles, mpm.static_poses(40, dtype=float))
    cloth = jax.jit(thin.step)(scene.thin, state.thin, thin.static_poses(40, dtype=float))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), end, end.replace(particles=sand, thin=cloth)
    )


def test_a_free_body_between_both_loses_nothing(x64):
    """A ball flies into the sand that lies on a cloth: all three share its momentum."""
    ball = Collider(shape=Sphere(radius=0.015), friction=0.3)
    scene, state = touching(colliders=(ball,), contact=PenaltyContact(stiffness=50.0, radius=2e-3))
    scene = scene.replace(particles=scene.particles.replace(colliders=(ball,)))
    inertia = free_body.Inertia(mass=jnp.array([0.01]), moment=1e-6 * jnp.eye(3)[None])
    body = free_body.bodies_at_rest(jnp.array([[0.0, -0.012, 0.0]])).replace(velocity=jnp.array([[0.0, 0.4, 0.1]]))

    def total(state, body):
        soft = invariants.momentum(scene.particles, state.particles) + thin.momentum(scene.thin, state.thin)
        return soft + free_body.momentum(body, inertia)

    end, after, wrench = jax.jit(coupling.step)(scene, inertia, state, body, coupling.static_poses(40, dtype=float))
    change = 0.01 * (after.velocity - body.velocity)[0]
    assert float(jnp.abs(change).max()) > 1e-5
    np.testing.assert_allclose(wrench.force[0] * 40 * scene.dt, change, rtol=1e-9)
    np.testing.assert_allclose(total(end, after), total(state, body), atol=1e-14)


def landed(scene, state):
    """A number from 12 substeps of sand that hits a cloth."""
    end = coupling.step_prescribed(scene, state, coupling.static_poses(12, dtype=float), store_every=3)
    leaves = (end.particles.x, 0.01 * end.particles.v, end.thin.x, 0.01 * end.thin.v)
    return sum(jnp.sum(jnp.cos(jnp.arange(a.size)).reshape(a.shape) * a) for a in leaves)


def test_reverse_is_forward_is_finite_difference(x64):
    scene, state = touching(held=[0, 4])
    slopes = jax.jit(jax.grad(landed, argnums=(0, 1)))(scene, state)
    value, forward = jax.jit(landed), jax.jit(lambda args, along: jax.jvp(landed, args, along)[1])
    zero = jax.tree.map(jnp.zeros_like, (scene, state))
    rng = np.random.default_rng(3)

    def noise(a):
        return jnp.asarray(rng.standard_normal(a.shape))

    law = jax.tree.map(lambda a: 0.1 * a, scene.contact).replace(max_speed=jnp.zeros(()))
    for name, along in {
        "contact": (zero[0].replace(contact=law), zero[1]),
        "particles": (zero[0], zero[1].replace(
            particles=zero[1].particles.replace(x=noise(state.particles.x), v=noise(state.particles.v)))),
        "cloth": (zero[0], zero[1].replace(thin=zero[1].thin.replace(x=noise(state.thin.x), v=noise(state.thin.v)))),
        "density of sand": (zero[0].replace(particles=zero[0].particles.replace(
            material=zero[0].particles.material.replace(density=jnp.asarray(1e4)))), zero[1]),
    }.items():  # fmt: skip
        reverse = sum(float(jnp.sum(a * b)) for a, b in zip(*map(jax.tree.leaves, (slopes, along)), strict=True))
        ends = [value(*jax.tree.map(lambda a, d, s=s: a + s * 1e-7 * d, (scene, state), along)) for s in (1, -1)]
        assert abs(reverse) > 1e-9, name
        np.testing.assert_allclose(reverse, forward((scene, state), along), rtol=1e-8, err_msg=name)
        np.testing.assert_allclose(reverse, float(ends[0] - ends[1]) / 2e-7, rtol=1e-4, err_msg=name)


def test_scenes_refuse_what_is_illegal_and_status_says_what_became_so(x64):
    mesh, rim = bag_mesh(4)
    grains = fill_box((0.0, -0.03, 0.0), (0.03, 0.03, 0.03), SPACING)
    for wrong, message in (
        ({"particles": sand_scene(5e-5)}, "particles.dt is 5e-05 s and thin.dt 0.0001 s"),
        ({"stiffness": 1e6}, "above the largest stable"),
        ({"max_speed": 50.0}, "contact.max_speed is 50 m/s, above"),
        ({"thickness": -1.0}, "contact.thickness is -1.0"),
    ):
        with pytest.raises(ValueError, match=message):
            both(mesh, grains, **wrong)
    rope = thin.rope(np.linspace([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], 5))
    strand = thin.make_scene(mesh=rope, dt=1e-4, rope=thin.Rope(stretch=100.0, density=0.1))
    with pytest.raises(ValueError, match="thin has no triangles"):
        both(rope, grains, thin_scene=strand)
    scene, state = both(mesh, grains, thin_scene=cloth_scene(mesh, held=rim))
    status = jax.jit(mixed.check_status)
    assert int(status(scene, state)) == 0
    short = scene.replace(contact=scene.contact.replace(pairs_per_particle=1, thickness=jnp.asarray(0.03)))
    assert int(status(short, state)) & Status.FULL_PAIRS
    stiff = scene.replace(contact=scene.contact.replace(stiffness=jnp.asarray(1e9)))
    assert int(status(stiff, state)) & Status.INVALID_PARAMETERS
