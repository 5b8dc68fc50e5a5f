"""Tetrahedra in motion: forces, analytic solutions, contact, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_shapes import Torus
from tet_bodies import (
    CONTACT,
    FLOOR,
    KINDS,
    MANY,
    MESH,
    NUM_TETS,
    NUM_VERTICES,
    STEP,
    at_rest,
    body,
    deformed,
    run,
    shaken,
    spin_matrix,
)

from rewax.physics import tets
from rewax.physics.contact.colliders import Collider
from rewax.physics.numerics.pose import Pose, static_poses
from rewax.physics.shapes import Plane, Sphere
from rewax.physics.tets.law import DampingLaw, stable_parameters
from rewax.physics.tets.stepping import TetState
from rewax.status import Status

FORCE_AND_SLOPE = jax.jit(
    lambda scene, state: (tets.internal_force(scene, state), jax.grad(lambda x: tets.elastic_energy(scene, state.replace(x=x)))(state.x))
)  # fmt: skip


# --- Forces -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_forces_are_minus_the_gradient_of_energy(x64, rotations, kind):
    """And sum to no force and no torque."""
    activation = 0.0 if kind in ("rest", "turned") else np.linspace(-0.1, 0.3, NUM_TETS)
    scene, state = body(mu=np.linspace(3e4, 5e4, NUM_TETS), lam=np.linspace(9e4, 5e4, NUM_TETS), activation=activation)
    state = state.replace(x=deformed(kind, state, rotations))
    force, slope = FORCE_AND_SLOPE(scene, state)
    scale = 4e4 * 0.2**2
    np.testing.assert_allclose(force, -slope, atol=1e-12 * scale)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-12 * scale)
    np.testing.assert_allclose(np.cross(state.x, force).sum(axis=0), 0.0, atol=1e-12 * scale)
    if kind in ("rest", "turned"):
        np.testing.assert_allclose(force, 0.0, atol=1e-11 * scale)


def test_a_stretched_and_a_sheared_block_pull_as_linear_elasticity_says(x64):
    """The force on an end is stress times area: E e, and G gamma, of a homogeneous deformation."""
    E, nu, e = 1e5, 0.3, 1e-6
    mu, lam = stable_parameters(E, nu)
    scene, state = body(mu=mu, lam=lam)
    end, area = np.asarray(state.x[:, 0] > 0.19), 0.2**2
    pulled = state.replace(x=state.x * jnp.array([1 + e, 1 - nu * e, 1 - nu * e]))
    force, _ = FORCE_AND_SLOPE(scene, pulled)
    np.testing.assert_allclose(force[end].sum(axis=0), [-E * e * area, 0, 0], atol=1e-4 * E * e * area)
    sheared = state.replace(x=state.x.at[:, 1].add(e * state.x[:, 0]))
    force, _ = FORCE_AND_SLOPE(scene, sheared)
    G = E / (2 * (1 + nu))
    np.testing.assert_allclose(force[end].sum(axis=0), [0, -G * e * area, 0], atol=1e-4 * G * e * area)


def test_damping_does_not_see_where_the_body_drifts(x64):
    """Galilean invariance: a common velocity changes no force. The reference's damping fails this."""
    scene, state = body(damping=30.0)
    state = shaken(state)
    shifted = state.replace(v=state.v + jnp.array([5.0, -7.0, 9.0]))
    still, moving = (FORCE_AND_SLOPE(scene, s)[0] for s in (state, shifted))
    assert np.abs(still - FORCE_AND_SLOPE(scene.replace(damping=scene.damping * 0), state)[0]).max() > 1.0
    np.testing.assert_allclose(moving, still, atol=1e-9)


def test_the_references_damping_brakes_rotation_by_this_torque(x64):
    """-2 damping volume omega for a block at rest shape; damping of strain rates leaves it alone."""
    omega = np.array([1.0, -2.0, 3.0])
    for law, torque in (
        (DampingLaw.VELOCITY_GRADIENT, -2 * 30.0 * MESH.volume * omega),
        (DampingLaw.STRAIN_RATE, 0 * omega),
    ):
        scene, state = body(damping=30.0, damping_law=law)
        force = tets.internal_force(scene, state.replace(v=state.x @ spin_matrix(omega).T))
        np.testing.assert_allclose(np.cross(state.x, force).sum(axis=0), torque, atol=1e-12)


# --- Analytic solutions -----------------------------------------------------------------------------------------------


def test_free_fall_is_symplectic_euler():
    """v_n = n g dt and x_n = x_0 + g dt^2 n (n + 1) / 2 for every vertex, in float32; held vertices stay."""
    g, n = np.array([1.0, -9.81, 2.0]), MANY
    scene, state = body(gravity=tuple(g), damping=5.0)
    end = run(scene, state)
    assert end.x.dtype == jnp.float32
    np.testing.assert_allclose(end.v, np.broadcast_to(n * scene.dt * g, end.v.shape), atol=2e-4)
    np.testing.assert_allclose(
        end.x - state.x, np.broadcast_to(g * scene.dt**2 * n * (n + 1) / 2, end.x.shape), atol=1e-4
    )


def test_held_vertices_keep_their_velocity(x64):
    held = np.flatnonzero(MESH.vertices[:, 0] < -0.19)
    scene, state = body(gravity=(0.0, -9.81, 0.0), held=held)
    state = state.replace(v=state.v.at[held[0]].set(jnp.array([0.1, 0.0, 0.0])))
    end = tets.substep(scene, state, *at_rest())
    np.testing.assert_array_equal(end.v[held], state.v[held])
    by_mask, _ = body(gravity=(0.0, -9.81, 0.0), held=MESH.vertices[:, 0] < -0.19)
    np.testing.assert_array_equal(by_mask.mobility, scene.mobility)
    free = np.setdiff1d(np.arange(NUM_VERTICES), held)
    np.testing.assert_allclose(end.v[free], np.broadcast_to([0, -9.81 * scene.dt, 0], (len(free), 3)), atol=1e-12)


# --- Contact ----------------------------------------------------------------------------------------------------------


def on_slope(angle, substeps, **changes):
    """A block on a plane that is tilted about z by an angle; returns its velocity down the plane over time."""
    g = 9.81 * np.array([np.sin(angle), -np.cos(angle), 0.0])
    scene, state = body(
        gravity=tuple(g), damping=20.0, damping_law=DampingLaw.VELOCITY_GRADIENT, contact=CONTACT, **changes
    )
    speeds = []
    for _ in range(substeps // MANY):
        state = run(scene, state)
        speeds.append(float(tets.momentum(scene, state)[0] / jnp.sum(scene.mass)))
    return scene, state, speeds


def test_a_block_sinks_by_its_weight_over_the_stiffness_and_sticks_or_slides(x64):
    """Below the friction angle it creeps at weight over friction damping, above it gains g (sin - mu cos)."""
    weight, bottom = 16.0 * 9.81, 6
    scene, state, speeds = on_slope(0.15, 2 * MANY, ground=FLOOR)
    creep = weight * np.sin(0.15) / (bottom * float(CONTACT.friction_damping))
    assert speeds[-1] == pytest.approx(creep, rel=1e-3)
    lowest = np.sort(np.asarray(state.x[:, 1]))[:bottom]
    depth = float(FLOOR.height + CONTACT.radius) - lowest.mean()
    assert depth == pytest.approx(weight * np.cos(0.15) / (bottom * float(CONTACT.stiffness)), rel=0.01)
    _, _, speeds = on_slope(0.8, 2 * MANY, ground=FLOOR)
    gained = (speeds[1] - speeds[0]) / (MANY * scene.dt)
    assert gained == pytest.approx(9.81 * (np.sin(0.8) - 0.5 * np.cos(0.8)), rel=0.01)


def test_a_collider_that_is_a_plane_is_a_ground(x64):
    plane = Collider(shape=Plane(), offset=np.array([0.0, FLOOR.height, 0.0]), rotation=np.eye(3), friction=0.5)
    scene, state = body(gravity=(1.0, -9.81, 0.0), contact=CONTACT, ground=FLOOR)
    state = shaken(state)
    expected = tets.contact_force(scene, state, *at_rest(1))
    assert np.count_nonzero(expected[:, 1]) > 3
    scene, _ = body(gravity=(1.0, -9.81, 0.0), contact=CONTACT, colliders=(plane,))
    np.testing.assert_allclose(tets.contact_force(scene, state, *at_rest(1)), expected, atol=1e-10)


# --- Derivatives ------------------------------------------------------------------------------------------------------

FEW = 20


def squeezed():
    """A shaken block on the ground under a ball that comes down and turns, some vertices sliding; all leaves arrays."""
    ball = Collider(shape=Sphere(radius=0.3), offset=np.array([0.0, 0.285, 0.01]), rotation=np.eye(3), friction=0.4)
    rng = np.random.default_rng(5)
    scene, state = body(
        gravity=(0.5, -9.81, 0.3), contact=CONTACT.replace(onset=0.004, depth_damping=500.0), ground=FLOOR, colliders=(ball,), damping=rng.uniform(5, 20, NUM_TETS), damping_law=DampingLaw.VELOCITY_GRADIENT,
        mu=rng.uniform(3e4, 5e4, NUM_TETS), lam=rng.uniform(5e4, 8e4, NUM_TETS), activation=rng.uniform(-0.1, 0.2, NUM_TETS),
    )  # fmt: skip
    t = scene.dt * np.arange(FEW + 1)
    turn = np.stack([np.eye(3) + np.sin(2 * a) * spin_matrix([0.3, 1.0, 0.2]) for a in t])
    poses = Pose(
        jnp.asarray((np.array([0.03, 0.108, 0.02]) + t[:, None] * [0.3, -0.6, 0.1])[:, None]),
        jnp.asarray(turn[:, None]),
    )
    return scene, shaken(state, 0.01, 1.0), poses


VALUE_AND_TANGENT = jax.jit(lambda args, move: jax.jvp(lambda a: tets.step(*a), (args,), (move,)))
VALUE_AND_GRADIENT = jax.jit(
    lambda args, ct: (lambda out, back: (out, back(ct)[0]))(*jax.vjp(lambda a: tets.step(*a), args))
)


def value(args):
    """Where 20 substeps end, by the program that also makes tangents: one less to compile."""
    return VALUE_AND_TANGENT(args, jax.tree.map(jnp.zeros_like, args))[0]


def inner(a, b) -> float:
    return sum(float(jnp.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def moves_of_each_leaf(random_like, args):
    """(name, direction) for every leaf: random, as large as the leaf; in all others zero."""
    leaves, treedef = jax.tree_util.tree_flatten_with_path(args)
    for index, (path, leaf) in enumerate(leaves):
        size = jnp.maximum(jnp.sqrt(jnp.mean(leaf**2)), 1e-3) * (1e-2 if path[0].idx == 2 else 1.0)
        move = [jnp.zeros_like(other) for _, other in leaves]
        move[index] = size * random_like(index, leaf)
        yield jax.tree_util.keystr(path), treedef.unflatten(move)


def weights(random_like, out):
    """A cotangent in which x and v count alike."""
    return jax.tree.map(lambda n, o: n / jnp.sqrt(jnp.mean(o**2)), random_like(1, out), out)


def test_twenty_substeps_reverse_forward_and_finite_difference_agree(x64, random_like, least_error):
    """With contact and friction, with respect to every leaf; repeats are bit-identical."""
    args = squeezed()
    out = value(args)
    cotangent = weights(random_like, out)
    end, gradient = VALUE_AND_GRADIENT(args, cotangent)
    jax.tree.map(np.testing.assert_array_equal, (end, gradient), VALUE_AND_GRADIENT(args, cotangent))
    modes, errors, idle = {}, {}, set()
    for name, move in moves_of_each_leaf(random_like, args):
        forward, reverse = inner(cotangent, VALUE_AND_TANGENT(args, move)[1]), inner(gradient, move)
        modes[name] = abs(reverse - forward) / max(abs(forward), 1e-3)
        steps = (1e-6, 1e-7, 1e-8, 1e-5)
        errors[name] = least_error(value, args, move, cotangent, reverse, steps=steps, bar=1e-5)
        idle |= {name} if reverse == 0 else set()
    print("20 substeps", {name: f"{error:.1e}" for name, error in errors.items()})
    assert idle <= {"[0].colliders[0].softness"}
    assert max(modes.values()) < 1e-9, modes
    assert max(errors.values()) < 1e-5, errors


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_at_special_states(x64, rotations, random_like, central_difference, kind):
    """At rest, turned, flattened, collapsed, inverted: finite, and those of finite differences."""
    scene, state, poses = squeezed()
    state = TetState(x=deformed(kind, state, rotations), v=0.1 * state.v)
    args = (scene.replace(dt=scene.dt), state, poses)
    out = value(args)
    cotangent = weights(random_like, out)
    _, gradient = VALUE_AND_GRADIENT(args, cotangent)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    move = jax.tree.map(jnp.zeros_like, args)
    move = (move[0].replace(mu=1e3 * random_like(2, scene.mu), activation=0.1 * random_like(3, scene.activation)), random_like(4, state), move[2])  # fmt: skip
    reverse = inner(gradient, move)
    differences = [inner(cotangent, central_difference(value, args, move, step)) for step in (1e-6, 1e-7, 1e-8)]
    assert min(abs(reverse - d) / max(abs(d), 1e-3) for d in differences) < 1e-5


def test_environments_do_not_mix_and_storing_changes_nothing(x64, random_like):
    """vmap = loop, NaN stays in its environment; store_every 2 or None is store_every 1."""
    scene, state = body()
    scene, state = scene.replace(damping=0.0), shaken(state)
    states = jax.tree.map(
        lambda a, n: a + 0.01 * n, state, random_like(0, jax.tree.map(lambda a: jnp.zeros((3, *a.shape)), state))
    )
    poses = static_poses(4, dtype=jnp.float64)
    cotangent = random_like(1, state)

    def gradient(activation, state, store_every=1):
        out, back = jax.vjp(
            lambda a, s: tets.step(scene.replace(activation=a), s, poses, store_every=store_every), activation, state
        )
        return out, back(cotangent)

    activation = 0.1 * jnp.ones((3, NUM_TETS))
    together = jax.jit(jax.vmap(gradient))
    fine = together(activation, states)
    poisoned = together(activation, states.replace(x=states.x.at[1, 3].set(jnp.nan)))
    assert np.isnan(poisoned[1][1].v[1]).any()
    for env in (0, 2):
        jax.tree.map(lambda a, b, e=env: np.testing.assert_array_equal(a[e], b[e]), poisoned, fine)
    first = jax.tree.map(lambda a: a[0], (activation, states))
    alone = jax.jit(lambda *args: gradient(*args, 2))(*first)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[0], b, rtol=1e-10, atol=1e-12), fine, alone)
    stored = STEP(scene.replace(activation=first[0]), first[1], poses, store_every=None)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[0], b, rtol=1e-12, atol=1e-13), fine[0], stored)
    with pytest.raises(ValueError, match="store_every is 3: give an integer that divides the 4 substeps"):
        tets.step(scene, state, poses, store_every=3)


def test_float32_stays_float32_and_nothing_is_promoted_in_silence():
    scene, state = body(damping=5.0, contact=CONTACT, ground=FLOOR)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        out = jax.eval_shape(tets.step, scene, state, static_poses(2, dtype=jnp.float32))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(out))


def test_status_bits():
    scene, state = body()
    status = jax.jit(tets.check_status)
    assert status(scene, state) == Status.OK
    assert status(scene, state.replace(x=state.x * jnp.array([1.0, -1.0, 1.0]))) == Status.INVERTED
    assert status(scene, state.replace(v=state.v.at[3, 1].set(jnp.nan))) == Status.NAN
    assert status(scene, state.replace(x=state.x.at[3, 1].set(jnp.inf))) & Status.NAN


def test_a_tool_between_the_vertices_is_reported():
    """A small ball meets no vertex of the face that it passes. A tool beside the body, or hollow, sets nothing."""
    scene, state = body(contact=CONTACT)
    status = jax.jit(tets.check_status)
    tet = np.asarray(state.x)[np.asarray(scene.topology.tets)[0]]
    middle, beyond = tet.mean(0), np.asarray(state.x).max(0) + 0.02
    for shape, offset, position, found in (
        (Sphere(radius=1e-3), jnp.zeros(3), middle, Status.PENETRATION),
        (Sphere(radius=1e-3), jnp.asarray(middle - beyond), beyond, Status.PENETRATION),
        (Sphere(radius=1e-3), jnp.zeros(3), beyond, Status.OK),
        (Torus(ring=1.0, tube=0.1), jnp.zeros(3), middle, Status.OK),
    ):
        tool = Collider(shape=shape, offset=offset, friction=0.0)
        held = scene.replace(colliders=(tool,))
        poses = Pose(jnp.asarray(np.stack([beyond, position]))[:, None], jnp.broadcast_to(jnp.eye(3), (2, 1, 3, 3)))
        assert status(held, state, poses=poses) == found
