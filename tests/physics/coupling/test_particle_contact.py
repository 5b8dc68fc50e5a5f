"""Particles against triangles: balance of forces and torques, an energy, a flat sheet without bumps, friction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import thin
from rewax.physics.coupling.particle_contact import (
    ParticleContact,
    contact_forces,
    particle_pairs,
    relative_speed,
    stopping_energy,
)
from rewax.physics.coupling.triangle_tree import TriangleTree
from rewax.physics.numerics import components as cp

MESH = thin.sheet(0.4, 0.4, 4, 4)
TREE = TriangleTree(MESH.triangles, MESH.vertices)
THICKNESS = 0.02


def law_of(**changes):
    return ParticleContact(**({"thickness": THICKNESS, "stiffness": 30.0, "pairs_per_particle": 30} | changes))


@jax.jit
def forces(law, particles, vertices):
    """Forces on particles and vertices, shapes (n, 3), from positions and velocities."""
    split = [tuple(cp.split_vector(a) for a in pair) for pair in (particles, vertices)]
    pairs = particle_pairs(law, TREE, 1e-4, split[0][0], split[1][0])
    return tuple(cp.join_vector(f) for f in contact_forces(law, pairs, *split))


def at_rest(x):
    x = jnp.asarray(x)
    return x, jnp.zeros_like(x)


def around_a_crumpled_sheet(seed=0, num=60):
    """Particles and vertices in motion, close to each other."""
    rng = np.random.default_rng(seed)
    x = np.asarray(MESH.vertices) + 0.02 * rng.standard_normal(MESH.vertices.shape)
    weights = rng.dirichlet(np.ones(3), num)
    on = np.einsum("nk,nki->ni", weights, x[np.asarray(MESH.triangles)[rng.integers(0, len(MESH.triangles), num)]])
    p = on + 0.008 * rng.standard_normal((num, 3))
    velocities = [0.3 * rng.standard_normal(a.shape) for a in (p, x)]
    return (jnp.asarray(p), jnp.asarray(velocities[0])), (jnp.asarray(x), jnp.asarray(velocities[1]))


def test_forces_sum_to_zero_and_torques_without_friction(x64):
    particles, vertices = around_a_crumpled_sheet()
    for friction in (0.0, 0.5):
        on_particles, on_vertices = forces(
            law_of(damping=0.1, friction=friction, friction_damping=0.2), particles, vertices
        )
        scale = float(jnp.abs(on_particles).sum())
        assert scale > 1.0
        np.testing.assert_allclose(on_particles.sum(0) + on_vertices.sum(0), 0.0, atol=1e-14 * scale)
        torque = jnp.cross(particles[0], on_particles).sum(0) + jnp.cross(vertices[0], on_vertices).sum(0)
        if friction == 0.0:
            np.testing.assert_allclose(torque, 0.0, atol=1e-14 * scale)
        else:  # friction acts at two points a distance below the thickness apart
            assert 1e-6 < float(jnp.abs(torque).max()) < THICKNESS * scale


def test_a_flat_sheet_pushes_equally_everywhere(x64):
    """Over edges and corners as over triangles, on both sides: the force of a plane."""
    rng = np.random.default_rng(3)
    inside = rng.uniform(0.1, 0.3, (200, 2))
    inside[:40] = np.asarray(MESH.vertices)[12][[0, 2]] + 1e-3 * rng.standard_normal((40, 2))  # near the middle corner
    inside[40:80, 0] = 0.2  # over edges
    height = rng.uniform(-THICKNESS, THICKNESS, 200)
    x = np.stack([inside[:, 0], height, inside[:, 1]], axis=1)
    law = law_of()
    on_particles, _ = forces(law, at_rest(x), at_rest(MESH.vertices))
    depth, onset = THICKNESS - np.abs(height), 0.25 * THICKNESS
    expected = 30.0 * np.where(depth < onset, depth**2 / (2 * onset), depth - 0.5 * onset) * np.sign(height)
    np.testing.assert_allclose(on_particles[:, 1], expected, atol=1e-12)
    np.testing.assert_allclose(on_particles[:, [0, 2]], 0.0, atol=1e-12)


def test_without_damping_the_work_around_a_closed_path_is_zero(x64):
    """The force is the gradient of an energy: particles and vertices move around a loop and gain nothing."""
    particles, vertices = around_a_crumpled_sheet(1, 20)
    rng = np.random.default_rng(5)
    one, two = ([jnp.asarray(3e-4 * rng.standard_normal(a.shape)) for a in (particles[0], vertices[0])] for _ in "ab")

    def power(angle):
        now = [a + jnp.cos(angle) * b + jnp.sin(angle) * c
               for a, b, c in zip((particles[0], vertices[0]), one, two, strict=True)]  # fmt: skip
        speed = [-jnp.sin(angle) * b + jnp.cos(angle) * c for b, c in zip(one, two, strict=True)]
        found = forces(law_of(), *(at_rest(a) for a in now))
        return sum(jnp.sum(f * v) for f, v in zip(found, speed, strict=True))

    powers = jax.lax.map(power, jnp.linspace(0.0, 2.0 * jnp.pi, 401)[:-1])
    assert float(jnp.abs(powers).mean()) > 1e-4
    assert abs(float(powers.mean())) < 1e-4 * float(jnp.abs(powers).mean())


def test_friction_is_bounded_by_coulomb_and_opposes_sliding(x64):
    law = law_of(friction=0.3, friction_damping=100.0)
    x, v = jnp.array([[0.15, 0.01, 0.17]]), jnp.array([[0.2, 0.0, 0.1]])
    force, _ = forces(law, (x, v), at_rest(MESH.vertices))
    along = np.asarray(force[0])[[0, 2]]
    np.testing.assert_allclose(along, -0.3 * float(force[0, 1]) * np.array([2.0, 1.0]) / np.sqrt(5.0), rtol=1e-9)


def test_the_stopping_energy_is_the_work_of_the_force(x64):
    law = law_of()
    heights = jnp.linspace(0.0, THICKNESS, 2001)
    x = jnp.stack([jnp.full_like(heights, 0.21), heights, jnp.full_like(heights, 0.17)], axis=1)
    force, _ = forces(law, at_rest(x), at_rest(MESH.vertices))
    np.testing.assert_allclose(np.trapezoid(force[1:, 1], heights[1:]), stopping_energy(law), rtol=2e-3)


def test_relative_speed_is_that_of_particle_and_cloth(x64):
    x, v = jnp.array([[0.15, 0.01, 0.17], [0.2, 0.5, 0.2]]), jnp.array([[0.0, -0.7, 0.0], [0.0, -9.0, 0.0]])
    still = at_rest(MESH.vertices)
    moving = (still[0], still[1].at[:, 1].set(0.2))

    @jax.jit
    def speed(particles, vertices):
        split = [tuple(cp.split_vector(a) for a in pair) for pair in (particles, vertices)]
        return relative_speed(particle_pairs(law_of(), TREE, 1e-4, split[0][0], split[1][0]), *split)

    np.testing.assert_allclose(speed((x, v), moving), 0.9)  # the second particle is far away


def test_reverse_is_forward_is_finite_difference(x64, agree_along):
    particles, vertices = around_a_crumpled_sheet(2)
    law = law_of(damping=0.05, friction=0.3, friction_damping=0.1)

    def value(law, particles, vertices):
        found = forces(law, particles, vertices)
        return sum(jnp.sum(jnp.cos(jnp.arange(f.size)).reshape(f.shape) * f) for f in found)

    args = (law, particles, vertices)
    rng = np.random.default_rng(7)
    along = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(jnp.shape(a))), args)
    along = (jax.tree.map(lambda a: 0.1 * a, law).replace(max_speed=jnp.zeros(())), *along[1:])
    agree_along(value, args, {"all": along}, step=1e-7, exact=1e-9, bar=1e-4)


def test_illegal_laws_are_refused():
    with pytest.raises(ValueError, match="pairs_per_particle"):
        law_of(pairs_per_particle=0)
