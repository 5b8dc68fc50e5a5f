"""Particles and free bodies: what they exchange is conserved, what is light stays calm, derivatives are exact."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material
from hypothesis import strategies as st
from sharded import traced_under_shard_map

from rewax.physics import coupling, mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.coupling import free_body
from rewax.physics.mpm import VonMises, invariants
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.walls import Wall, WallKind, Walls
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Box, Sphere
from rewax.physics.shapes.sampling import fill_box

SPACING, GRAVITY = 0.02, 9.81
ABOVE_FLOOR = 0.08
"""The dough begins so far above the floor, which it reaches only in the test that lets it rest [m]."""
BOX = Box(half_size=jnp.array([0.03, 0.02, 0.03]))


def collider(shape, body=0, offset=(0.0, 0.0, 0.0), friction=0.4):
    return Collider(
        shape=shape,
        offset=jnp.asarray(offset),
        rotation=jnp.eye(3),
        friction=jnp.asarray(friction),
        softness=jnp.asarray(200.0),
        body=body,
    )


@pytest.fixture(scope="module")
def dough():
    """A block of dough, a box over it: (scene, state); colliders 0 and 1 are the box and a ball fixed to it."""
    x = fill_box((0.1, ABOVE_FLOOR + 0.08, 0.1), (0.08, 0.04, 0.08), 0.5 * SPACING)
    scene = mpm.make_scene(
        grid=Grid(shape=(11, 15, 11), spacing=SPACING), dt=4e-4, particle_volume=jnp.asarray(0.08 * 0.04 * 0.08 / len(x)),
        material=flat_material(youngs_modulus=5e3, poissons_ratio=0.3, yield_stress=200.0, plasticity=VonMises),
        walls=Walls(lower=(None, Wall(position=0.0601, kind=WallKind.GRIPPING), None), upper=(None,) * 3),
        gravity=(0.0, 0.0, 0.0), colliders=(collider(BOX), collider(Sphere(radius=jnp.asarray(0.015)), offset=(0.0, -0.02, 0.0))),
    )  # fmt: skip
    return scene, mpm.initial_state(jnp.asarray(x), scene)


def falling(velocity=(0.02, -0.1, 0.01), spin=(1.0, 2.0, -3.0)):
    return free_body.bodies_at_rest([[0.105, ABOVE_FLOOR + 0.13, 0.1]]).replace(
        velocity=jnp.asarray([velocity]), angular_velocity=jnp.asarray([spin])
    )


@pytest.fixture(scope="module")
def run():
    """``run(scene, inertia, state, bodies)``: 100 substeps, compiled once."""

    @jax.jit
    def hundred(scene, inertia, state, bodies, wrench):
        return coupling.step(scene, inertia, state, bodies, mpm.static_poses(100), wrench=wrench)

    return lambda *args, wrench=None: hundred(*args, coupling.no_wrench(1) if wrench is None else wrench)


def inertia_of(mass):
    moment = mass * jnp.diag(jnp.array([0.02**2 + 0.03**2, 2 * 0.03**2, 0.02**2 + 0.03**2])) / 3.0
    return free_body.Inertia(mass=jnp.asarray([mass]), moment=moment[None])


@pytest.mark.parametrize(
    ("mass", "tilt"),
    [pytest.param(0.3, 0.0, marks=pytest.mark.slow), (0.01, 0.0), (0.0003, 0.6)],
    ids=["heavy", "light", "sheet"],
)
def test_momentum_of_particles_and_body_is_conserved_over_1000_substeps(dough, run, mass, tilt):
    """The dough weighs 0.26 kg: a body that answered late would be thrown by it."""
    scene, state = dough
    inertia, bodies = inertia_of(mass), falling()
    turn = np.array([np.cos(tilt / 2), *np.sin(tilt / 2) * np.array([0.6, 0.0, 0.8])])
    bodies = bodies.replace(orientation=jnp.asarray(turn, jnp.float32)[None])

    def total(state, bodies):
        linear = invariants.momentum(scene, state) + free_body.momentum(bodies, inertia)
        about = (0.1, 0.18, 0.1)
        angular = invariants.angular_momentum(scene, state, about) + free_body.angular_momentum(bodies, inertia, about)
        return np.asarray(linear, np.float64), np.asarray(angular, np.float64)

    linear, angular = total(state, bodies)
    energy = float(free_body.kinetic_energy(bodies, inertia))
    received = 0.0
    for _ in range(10):
        state, bodies, wrench = run(scene, inertia, state, bodies)
        received = received + np.asarray(wrench.force[0]) * 100 * scene.dt
    linear_after, angular_after = total(state, bodies)
    assert np.linalg.norm(linear_after - linear) < 1e-5 * np.linalg.norm(linear)
    # The light body's angular momentum is small beside what its momentum has at the distance of the bodies' size.
    assert np.linalg.norm(angular_after - angular) < 1e-5 * max(np.linalg.norm(angular), 0.1 * np.linalg.norm(linear))
    # Something happened, and what the body reports to have received is what changed its momentum.
    assert float(jnp.linalg.norm(bodies.velocity)) < 0.15  # not thrown
    change = np.asarray(mass * (bodies.velocity[0] - falling().velocity[0]))
    assert np.linalg.norm(change) > 0.3 * np.linalg.norm(linear)
    np.testing.assert_allclose(received, change, rtol=1e-3, atol=1e-4 * np.linalg.norm(linear))
    assert float(free_body.kinetic_energy(bodies, inertia) + invariants.kinetic_energy(scene, state)) < energy
    assert int(mpm.check_status(scene, state)) == 0


def test_a_box_dropped_on_dough_comes_to_rest_on_it(dough, run):
    """On a floor, under gravity: velocity goes to zero and the dough carries the weight."""
    scene, state = dough
    scene = scene.replace(gravity=jnp.array([0.0, -GRAVITY, 0.0]))
    inertia, bodies = inertia_of(0.05), falling(velocity=(0.0, -0.2, 0.0), spin=(0.0, 0.0, 0.0))
    state = state.replace(x=state.x - jnp.array([0.0, ABOVE_FLOOR, 0.0]))
    bodies = bodies.replace(position=bodies.position - jnp.array([0.0, ABOVE_FLOOR, 0.0]))
    forces = []
    for _ in range(10):
        state, bodies, wrench = run(scene, inertia, state, bodies)
        forces.append(np.asarray(wrench.force[0]))
    weight = 0.05 * GRAVITY
    np.testing.assert_allclose(np.mean(forces[-4:], axis=0), [0.0, weight, 0.0], atol=0.1 * weight)
    assert float(jnp.linalg.norm(bodies.velocity)) < 0.02 and float(jnp.linalg.norm(bodies.angular_velocity)) < 0.2
    bottom = float(bodies.position[0, 1]) - 0.035  # the ball below the box reaches 1.5 cm deeper
    assert 0.06 < bottom < 0.1


def test_a_free_body_falls_and_spins_as_alone(dough, run):
    """No contact: free fall by symplectic Euler, angular momentum of an asymmetric body constant, wrench as given."""
    scene, state = dough
    scene = scene.replace(gravity=jnp.array([0.0, -GRAVITY, 0.0]))
    inertia = free_body.Inertia(mass=jnp.array([0.5]), moment=jnp.diag(jnp.array([1.0, 2.0, 3.5]))[None] * 1e-4)
    bodies = free_body.bodies_at_rest([[0.1, 0.5, 0.1]]).replace(angular_velocity=jnp.array([[3.0, 10.0, 0.2]]))
    push = coupling.Wrench(jnp.array([[1.0, 0.0, 0.0]]), jnp.array([[0.0, 0.0, 2e-4]]))
    after = run(scene, inertia, state, bodies, wrench=push)[1]
    n, dt = 100, scene.dt
    fallen = n * (n + 1) / 2 * dt**2
    expected = np.array([0.1 + 2.0 * fallen, 0.5 - GRAVITY * fallen, 0.1])
    np.testing.assert_allclose(after.position[0], expected, atol=2e-6)
    spin = free_body.angular_momentum(after, inertia, after.position[0]) - free_body.angular_momentum(
        bodies, inertia, bodies.position[0]
    )
    np.testing.assert_allclose(spin, [0.0, 0.0, 2e-4 * n * dt], atol=2e-8)
    np.testing.assert_allclose(jnp.linalg.norm(after.orientation), 1.0, atol=1e-6)


@pytest.fixture(scope="module")
def twenty(derivatives, random_like):
    """``twenty(arguments, tangents)``: outcome of 20 substeps, its forward derivative, weights and reverse derivative."""

    def outcome(arguments):
        scene, inertia, state, bodies, poses, wrench = arguments
        state, bodies, reaction = coupling.step(scene, inertia, state, bodies, poses, wrench=wrench)
        return state.x, state.F, bodies, reaction

    def weights(value):
        return random_like(2, value)

    program = derivatives(outcome)
    return lambda arguments, tangents: program(arguments, tangents, weights=weights)


def pushed_from_two_sides(scene, state):
    """Arguments of ``twenty``: a free box comes from above, a ball that moves as prescribed from the side."""
    shapes = (collider(BOX), collider(Sphere(radius=jnp.asarray(0.02)), body=1))
    scene = scene.replace(colliders=shapes, gravity=jnp.array([0.0, -1.0, 0.0]))
    bodies = falling(velocity=(0.1, -0.5, 0.05)).replace(position=jnp.array([[0.105, ABOVE_FLOOR + 0.121, 0.1]]))
    path = jnp.linspace(0.0, 1.0, 21)[:, None, None] * jnp.array([0.004, 0.0, 0.0]) + jnp.array(
        [[0.045, ABOVE_FLOOR + 0.08, 0.1]]
    )
    poses = Pose(path, jnp.broadcast_to(jnp.eye(3), (21, 1, 3, 3)))
    wrench = coupling.Wrench(jnp.array([[0.1, 0.2, 0.0]]), jnp.array([[0.0, 1e-3, 0.0]]))
    arguments = (scene, inertia_of(0.05), state, bodies, poses, wrench)
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), arguments)


def directions(arguments, random_like, seed=1):
    """Of the size of what they change."""
    return jax.tree.map(lambda a, d: d * (1e-3 + jnp.mean(jnp.abs(a))), arguments, random_like(seed, arguments))


def test_derivatives_equal_finite_differences_over_20_substeps(x64, dough, twenty, random_like, relative_error, inner):
    """Reverse = forward = difference with respect to particles, body, mass, shape, friction, material and a wrench."""
    scene, state = dough
    arguments = pushed_from_two_sides(scene, state.replace(v=0.05 * random_like(0, state.v)))
    tangents = directions(arguments, random_like)
    _, forward, weights, gradient = twenty(arguments, tangents)
    # What no derivative sees, the onset of contact, must not be crossed by the difference: small steps.
    ahead, behind = (
        twenty(jax.tree.map(lambda a, d: a + h * d, arguments, tangents), tangents)[0] for h in (1e-7, -1e-7)
    )
    difference = jax.tree.map(lambda a, b: (a - b) / 2e-7, ahead, behind)
    assert relative_error(forward, difference) < 1e-5
    assert abs(inner(gradient, tangents) - inner(weights, forward)) < 1e-9 * abs(inner(weights, forward))
    for name, part in zip(("scene", "inertia", "state", "bodies", "poses", "wrench"), gradient, strict=True):
        assert any(float(jnp.abs(leaf).max()) > 0 for leaf in jax.tree.leaves(part)), name


@hypothesis.settings(max_examples=8)
@hypothesis.given(
    stretches=st.sampled_from([(1.0, 1.0, 1.0), (1.2, 1.2, 0.7), (1.0, 1.0, 1e-6), (0.9, 0.9, 0.9), (1.1, 0.9, -0.1)]),
    on_boundaries=st.booleans(),
    height=st.sampled_from([0.12, 0.125, 0.121]),
    turned=st.booleans(),
    seed=st.integers(0, 3),
)
def test_derivatives_are_finite_and_reverse_equals_forward_at_special_states(
    x64, dough, twenty, random_like, inner, stretches, on_boundaries, height, turned, seed
):
    """Repeated and vanishing stretches, inverted particles, particles midway between nodes, faces of the box on nodes.

    There derivatives are one-sided, and both directions take the same side.
    """
    scene, state = dough
    state = state.replace(F=state.F * jnp.asarray(stretches), v=0.05 * random_like(seed, state.v))
    if on_boundaries:
        state = state.replace(x=(jnp.floor(state.x / SPACING) + 0.5) * SPACING)
    arguments = list(pushed_from_two_sides(scene, state))
    spin = 0.0 if not turned else 0.3
    arguments[3] = arguments[3].replace(
        position=jnp.array([[0.11, ABOVE_FLOOR + height, 0.1]]),
        angular_velocity=jnp.array([[0.0, 0.0, spin]]),
        velocity=jnp.array([[0.0, -0.5, 0.0]]),
    )
    arguments = tuple(arguments)
    tangents = directions(arguments, random_like, seed)
    value, forward, weights, gradient = twenty(arguments, tangents)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((value, forward, gradient)))
    assert abs(inner(gradient, tangents) - inner(weights, forward)) < 1e-8 * abs(inner(weights, forward)) + 1e-12


def test_bodies_that_move_as_prescribed_feel_the_particles(dough):
    """Without free bodies: a touch sensor. The particles move as in the one-way step."""
    scene, state = dough
    scene = scene.replace(colliders=(collider(Sphere(radius=jnp.asarray(0.02))),))
    start = jnp.array([[0.1, ABOVE_FLOOR + 0.115, 0.1]])
    path = start + jnp.linspace(0.0, 1.0, 21)[:, None, None] * jnp.array([0.0, -0.004, 0.0])
    poses = Pose(path, jnp.broadcast_to(jnp.eye(3), (21, 1, 3, 3)))
    none = free_body.bodies_at_rest(jnp.zeros((0, 3)))
    inertia = free_body.Inertia(mass=jnp.zeros(0), moment=jnp.zeros((0, 3, 3)))
    end, _, wrench = jax.jit(coupling.step)(scene, inertia, state, none, poses)
    np.testing.assert_allclose(end.v, jax.jit(mpm.step)(scene, state, poses).v, atol=1e-6)
    gained = invariants.momentum(scene, end) - invariants.momentum(scene, state)
    assert float(wrench.force[0, 1]) > 1e-3
    np.testing.assert_allclose(wrench.force[0] * 20 * scene.dt, -gained, rtol=1e-3, atol=1e-7)


def test_clear_errors(dough):
    scene, state = dough
    with pytest.raises(ValueError, match="inertia has 1 bodies, but there are 2 free bodies"):
        coupling.step(scene, inertia_of(0.1), state, free_body.bodies_at_rest(jnp.zeros((2, 3))), mpm.static_poses(2))
    other = scene.replace(colliders=(collider(BOX, body=3),))
    with pytest.raises(ValueError, match="collider 0 belongs to body 3, but there are poses of 1 bodies"):
        coupling.step(other, inertia_of(0.1), state, falling(), mpm.static_poses(2))
    with pytest.raises(ValueError, match="give an array of shape \\(num_bodies, 3\\)"):
        free_body.bodies_at_rest([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"density is -1\.0, but must be positive"):
        free_body.solid(BOX, -1.0)


def test_inside_shard_map(dough):
    def after(state, bodies):
        return coupling.step(dough[0], inertia_of(0.1), state, bodies, mpm.static_poses(2))

    state, bodies, wrench = traced_under_shard_map(after, dough[1], falling())
    assert state.x.shape == (1, *dough[1].x.shape)
    assert bodies.position.shape == wrench.force.shape == (1, 1, 3)


def test_a_wrench_has_a_row_for_each_free_body(dough):
    scene, state = dough
    bodies = free_body.bodies_at_rest([[0.1, 0.5, 0.1]])
    inertia = free_body.Inertia(mass=jnp.array([0.5]), moment=1e-4 * jnp.eye(3)[None])
    for wrench in (coupling.no_wrench(2), coupling.Wrench(jnp.zeros(3), jnp.zeros(3))):
        with pytest.raises(ValueError, match=r"wrench.force has shape .*: give one of shape \(1, 3\), a row for each"):
            coupling.step(scene, inertia, state, bodies, mpm.static_poses(2), wrench=wrench)
