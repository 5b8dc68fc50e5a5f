"""Tetrahedra and free bodies: momentum kept to rounding, light bodies calm, weights carried, derivatives exact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import coupling, tets
from rewax.physics.contact import Collider, Ground, PenaltyContact
from rewax.physics.contact.motion import Motion
from rewax.physics.coupling import free_body
from rewax.physics.coupling.soft import TETRAHEDRA
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box, Sphere
from rewax.physics.tets import DampingLaw, tetmesh

MESH = tetmesh.box((0.2, 0.1, 0.2), (4, 2, 4), tets_per_cell=5)
HALF = np.array([0.06, 0.03, 0.06])
GRAVITY, RADIUS, TOP = 9.81, 0.005, 0.055
"""The block's upper face is at 5 cm; what is nearer than the radius touches [m]."""


def floor(height):
    return Ground(normal=jnp.array([0.0, 1.0, 0.0]), height=height)


def block(**changes):
    """A soft block of 4 kg under a box: (scene, vertices), at a substep just below the largest stable one."""
    law = PenaltyContact(stiffness=2e3, damping=2.0, friction_damping=5.0, friction=0.5, radius=RADIUS)
    settings = dict(
        mesh=MESH, density=1000.0, mu=4e4, lam=6e4, dt=1.3e-3, damping=5.0, damping_law=DampingLaw.STRAIN_RATE, contact=law,
        gravity=(0.0, 0.0, 0.0), ground=floor(-1.0), colliders=(Collider(shape=Box(half_size=jnp.asarray(HALF)), friction=0.4),),
    )  # fmt: skip
    scene = tets.make_scene(**(settings | changes))
    return jax.tree.map(lambda a: jnp.asarray(a, float), scene), tets.initial_state(MESH.vertices)


def inertia_of(mass):
    a, b, c = HALF**2
    return free_body.Inertia(
        mass=jnp.asarray([mass]), moment=mass / 3.0 * jnp.diag(jnp.array([b + c, a + c, a + b]))[None]
    )


def falling(height=0.09, velocity=(0.1, -0.5, 0.05), spin=(1.0, 2.0, -3.0)):
    return free_body.bodies_at_rest(jnp.array([[0.013, height, 0.004]], float)).replace(
        velocity=jnp.asarray([velocity]), angular_velocity=jnp.asarray([spin])
    )


RUN = jax.jit(coupling.step, static_argnames="store_every")


def run(scene, inertia, state, bodies, num=100, wrench=None):
    wrench = coupling.no_wrench(1, state.x) if wrench is None else wrench
    return RUN(scene, inertia, state, bodies, tets.static_poses(num, dtype=state.x.dtype), wrench=wrench)


@pytest.mark.parametrize("mass", [1.0, 1e-3, 1e-6])
def test_momentum_of_tets_and_body_is_conserved_to_rounding(x64, mass):
    """The block weighs 4 kg: a body that answered late would be thrown by it."""
    scene, state = block()
    inertia, bodies = inertia_of(mass), falling()

    def total(state, bodies):
        linear = tets.momentum(scene, state) + free_body.momentum(bodies, inertia)
        return linear, tets.angular_momentum(scene, state) + free_body.angular_momentum(bodies, inertia)

    before, received = total(state, bodies), 0.0
    for _ in range(4):
        state, bodies, wrench = run(scene, inertia, state, bodies)
        received = received + wrench.force[0] * 100 * scene.dt
        assert float(jnp.abs(bodies.velocity).max()) < 0.6 and float(jnp.abs(bodies.angular_velocity).max()) < 4.0
    for found, expected in zip(total(state, bodies), before, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12 * float(jnp.abs(expected).max()))
    change = mass * (bodies.velocity - falling().velocity)[0]
    assert float(change[1]) > 0.5 * mass  # it bounced
    np.testing.assert_allclose(received, change, atol=1e-12 * mass)


def test_a_body_that_nothing_moves_does_what_a_prescribed_one_does(x64):
    """A thousand tons, slowly into the block: as ``tets.step`` with the body's path, ground and friction included."""
    scene, state = block(ground=floor(-0.054), gravity=(0.0, -1.0, 0.0))
    bodies, inertia = falling(0.0851, (0.05, -0.1, 0.0), (0.0, 0.5, 0.0)), inertia_of(1e6)

    def moved(body, _):
        pushed = free_body.push(body, inertia, jnp.array([[0.0, -1e6 * scene.dt, 0.0]]), jnp.zeros((1, 3)))
        after = free_body.move(pushed, inertia, scene.dt)
        return after, free_body.poses(after)

    path = jax.jit(lambda body: jax.lax.scan(moved, body, None, length=100)[1])(bodies)
    poses = jax.tree.map(lambda first, a: jnp.concatenate([first[None], a]), free_body.poses(bodies), path)
    found = run(scene, inertia, state, bodies)[0]
    alone = jax.jit(tets.step)(scene, state, poses)
    assert float(jnp.abs(alone.x - state.x).max()) > 2e-3
    # Its surface's velocity is that along the chord there, that of the substep's beginning here: first order in dt.
    np.testing.assert_allclose(found.x, alone.x, atol=2e-6)


@pytest.mark.parametrize("mass", [1e-1, 1e-3, 1e-6])
def test_bodies_of_any_mass_are_calm_at_the_largest_stable_substep(x64, mass):
    """Pressed on the block with twenty times its weight; springs explicit on both sides ask for k dt^2 << mass."""
    scene, state = block(ground=floor(-TOP), gravity=(0.0, -GRAVITY, 0.0))
    assert scene.dt > 0.97 * float(tets.largest_stable_dt(scene))
    bodies = falling(TOP + HALF[1], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    bodies = bodies.replace(position=bodies.position * jnp.array([0.0, 1.0, 0.0]))
    push = coupling.Wrench(jnp.array([[0.0, -20.0 * GRAVITY * mass, 0.0]]), jnp.zeros((1, 3)))
    fastest = []
    for _ in range(12):
        state, bodies, wrench = run(scene, inertia_of(mass), state, bodies, wrench=push)
        fastest.append(max(float(jnp.abs(bodies.velocity).max()), float(jnp.abs(state.v).max())))
    assert max(fastest) < 0.2 and fastest[-1] < 1e-3
    assert int(tets.check_status(scene, state)) == 0
    np.testing.assert_allclose(wrench.force[0, 1], 21.0 * GRAVITY * mass, rtol=1e-3)


def test_a_block_carries_a_box(x64):
    """At rest the wrench is the weight, and springs are as compressed as without the implicit part."""
    scene, state = block(ground=floor(-TOP), gravity=(0.0, -GRAVITY, 0.0))
    bodies = falling(TOP + HALF[1] - 5e-4, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    bodies = bodies.replace(position=bodies.position * jnp.array([0.0, 1.0, 0.0]))
    for _ in range(40):
        state, bodies, wrench = run(scene, inertia_of(0.5), state, bodies)
    np.testing.assert_allclose(wrench.force[0], [0.0, 0.5 * GRAVITY, 0.0], atol=2e-3 * 0.5 * GRAVITY)
    np.testing.assert_allclose(wrench.torque[0], 0.0, atol=1e-9)
    assert float(jnp.abs(bodies.velocity).max()) < 1e-4
    below = jnp.maximum(bodies.position[0, 1] - HALF[1] - state.x[:, 1], 0.0)
    under = (
        (jnp.abs(state.x[:, 0]) < HALF[0]) & (jnp.abs(state.x[:, 2]) < HALF[2]) & (below < RADIUS) & (state.x[:, 1] > 0)
    )
    held = 2e3 * jnp.sum(jnp.where(under, RADIUS - below, 0.0))
    np.testing.assert_allclose(held, 0.5 * GRAVITY, rtol=5e-3)


def test_bodies_that_move_as_prescribed_feel_the_tets(x64):
    scene, state = block(colliders=(Collider(shape=Sphere(radius=0.04), friction=0.4),))
    path = jnp.array([0.0, 0.09, 0.0]) + jnp.linspace(0.0, 1.0, 41)[:, None, None] * jnp.array([0.002, -0.01, 0.0])
    poses = Pose(path, jnp.broadcast_to(jnp.eye(3), (41, 1, 3, 3)))
    none = free_body.bodies_at_rest(jnp.zeros((0, 3)))
    inertia = free_body.Inertia(mass=jnp.zeros(0), moment=jnp.zeros((0, 3, 3)))
    end, _, wrench = jax.jit(coupling.step)(scene, inertia, state, none, poses)
    np.testing.assert_allclose(end.x, jax.jit(tets.step)(scene, state, poses).x, atol=1e-13)
    assert float(wrench.force[0, 1]) > 1.0
    np.testing.assert_allclose(wrench.force[0] * 40 * scene.dt, -tets.momentum(scene, end), atol=1e-12)


def test_the_predicted_velocity_is_the_one_that_follows(x64):
    """Forces are linear in the bodies' velocity: what bodies receive brings them to the velocity it was computed with."""
    scene, state = block()
    state = state.replace(v=0.1 * jnp.asarray(np.random.default_rng(0).normal(size=state.v.shape)))
    bodies, inertia = falling(0.083), inertia_of(1e-4)
    contact = TETRAHEDRA.begin(scene, TETRAHEDRA.constants(scene, state), TETRAHEDRA.split(state))

    def motions(b):
        return [Motion(*(a[0] for a in free_body.motions(b)))]

    pushed = free_body.push(bodies, inertia, jnp.array([[0.0, -1e-4, 0.0]]), jnp.zeros((1, 3)))
    contact = contact.meet(free_body.poses(bodies), motions(pushed), lambda: motions(bodies))
    a, b, c, right = contact.system(0, bodies.position[0])
    whole = np.block([[a, b], [b.T, c]]) + np.block(
        [[1e-4 * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), inertia.moment[0]]]
    )
    change = np.linalg.solve(whole, right)
    predicted = pushed.replace(
        velocity=pushed.velocity + change[:3], angular_velocity=pushed.angular_velocity + change[3:]
    )
    _, given = contact.exchange(motions(predicted), bodies.position)
    after = free_body.push(pushed, inertia, *given)
    np.testing.assert_allclose(after.velocity, predicted.velocity, rtol=1e-9)
    np.testing.assert_allclose(after.angular_velocity, predicted.angular_velocity, rtol=1e-9)
    assert np.abs(change).max() > 0.1


def test_a_body_without_friction_feels_no_drag(x64, derivatives):
    """It lies on the block and begins to slide: neither the impulse nor its derivative has a tangential part."""
    shapes = (Collider(shape=Box(half_size=jnp.asarray(HALF)), friction=0.0),)
    scene, state = block(colliders=shapes)
    bodies = free_body.bodies_at_rest(jnp.array([[0.0, TOP + HALF[1] - 1e-3, 0.0]], float))

    def impulse(velocity):
        contact = TETRAHEDRA.begin(scene, TETRAHEDRA.constants(scene, state), TETRAHEDRA.split(state))
        still, sliding = (Motion(jnp.zeros((3, 3)), v) for v in (jnp.zeros(3), velocity))
        contact = contact.meet(free_body.poses(bodies), [sliding], lambda: [still])
        return contact.exchange([None], bodies.position)[1].impulse[0]

    sideways = jnp.array([0.3, 0.0, 0.0])
    value, forward, _, reverse = derivatives(impulse)(jnp.zeros(3), sideways, lambda v: jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(value[1:] > 0, [True, False])
    np.testing.assert_allclose([*forward, *reverse, *value[::2], *impulse(sideways)[::2]], 0.0, atol=1e-12)


def test_derivatives_equal_finite_differences(x64, random_like, derivatives_agree):
    """Reverse = forward = difference over 20 substeps, by vertices, body, masses, material, contact, path and push."""
    shapes = tuple(Collider(shape=Sphere(radius=r), friction=0.3, body=i) for i, r in enumerate((0.05, 0.03)))
    scene, state = block(ground=floor(-0.053), gravity=(0.0, -1.0, 0.0), colliders=shapes)
    state = state.replace(v=0.05 * random_like(0, state.v))
    path = jnp.array([-0.128, 0.0, 0.01]) + jnp.linspace(0.0, 1.0, 21)[:, None, None] * jnp.array([0.003, 0.0, 0.0])
    poses = Pose(path, jnp.broadcast_to(jnp.eye(3), (21, 1, 3, 3)))
    wrench = coupling.Wrench(jnp.array([[0.1, 0.2, 0.0]]), jnp.array([[0.0, 1e-3, 0.0]]))
    arguments = (scene, inertia_of(0.02), state, falling(0.1, (0.1, -0.3, 0.05)), poses, wrench)
    arguments = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), arguments)
    tangents = jax.tree.map(lambda a, d: d * (1e-3 + jnp.mean(jnp.abs(a))), arguments, random_like(1, arguments))
    # The body's rest shape and its masses cannot change at random: its volumes would not fit together.
    tangents[0].__dict__.update(inverse_rest_edges=0.0 * scene.inverse_rest_edges)

    def outcome(arguments):
        scene, inertia, state, bodies, poses, wrench = arguments
        return coupling.step(scene, inertia, state, bodies, poses, wrench=wrench)

    _, gradient = derivatives_agree(outcome, arguments, tangents, step=1e-8, bar=1e-5, exact=1e-9)
    for name in ("mu", "lam", "damping", "mass", "gravity"):
        assert float(jnp.abs(getattr(gradient[0], name)).max()) > 0, name
    for name, part in zip(("inertia", "state", "bodies", "poses", "wrench"), gradient[1:], strict=True):
        assert any(float(jnp.abs(leaf).max()) > 0 for leaf in jax.tree.leaves(part)), name
