"""Cloth and ropes in motion: pins, contact, derivatives, status."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER
from thin_bodies import KINDS, LINE, SHEET, STEP, cloth_scene, rope_scene, run, shaken

from rewax.lowering import recorded
from rewax.physics import thin
from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Sphere


def test_held_vertices_follow_their_pins(x64):
    scene = rope_scene(held=[8, 0])
    pins = jnp.asarray(np.linspace([[1, 0, 0], [0, 0, 0]], [[1, 0.1, 0], [0, 0, 0.1]], 51)[1:])
    end = STEP(scene, thin.initial_state(LINE.vertices), thin.static_poses(50, dtype=float), pins=pins)
    np.testing.assert_array_equal(end.x[jnp.array([8, 0])], pins[-1])
    np.testing.assert_allclose(end.v[8], [0, 0.1 / 50 / scene.dt, 0], rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="pins has shape"):
        thin.step(scene, end, thin.static_poses(49, dtype=float), pins=pins)


def test_drag_slows_every_vertex_at_its_rate(x64):
    """v' = g - drag v by symplectic Euler, while nothing deforms."""
    scene, steps = cloth_scene(drag=50.0, gravity=(0.0, -9.81, 0.0)), 100
    end = run(scene, thin.initial_state(SHEET.vertices), steps)
    fallen = -9.81 / 50.0 * (1.0 - (1.0 - 50.0 * scene.dt) ** steps)
    np.testing.assert_allclose(end.v, np.broadcast_to([0.0, fallen, 0.0], end.v.shape), rtol=1e-9, atol=1e-12)


def test_friction_on_an_incline_slides_and_sticks(x64):
    """Acceleration is g (sin - mu cos) along the slope, and none where mu exceeds the tangent."""
    slope, time = 0.4, 0.3
    normal = np.array([np.sin(slope), np.cos(slope), 0.0])
    down = np.array([np.cos(slope), -np.sin(slope), 0.0])
    gravity = 9.81 * (np.sin(slope) * down - np.cos(slope) * normal)
    for friction in (0.2, 0.6):
        contact = PenaltyContact(stiffness=200.0, damping=1.0, friction_damping=20.0, friction=friction)
        ground = Ground(normal=tuple(normal))
        scene = cloth_scene(gravity=tuple(gravity), contact=contact, ground=ground)
        depth = np.asarray(scene.mass)[:, None] * 9.81 * np.cos(slope) / 200.0
        level = np.asarray(SHEET.vertices)
        x = level[:, :1] * down + level[:, 2:] * [0.0, 0.0, 1.0] - depth * normal
        start = thin.initial_state(x)
        end = run(scene, start, round(time / scene.dt))
        speed = float(np.average(np.asarray(end.v) @ down, weights=np.asarray(scene.mass)))
        expected = max(9.81 * (np.sin(slope) - friction * np.cos(slope)) * time, 0.0)
        np.testing.assert_allclose(speed, expected, rtol=0.01, atol=0.01)


def dropped(scene, state, pins, vertices):
    """A number from 20 substeps of a cloth that a sphere pushes, whose rest shape is ``vertices``."""
    scene = scene.replace(rest=thin.rest_shape(scene.topology, vertices))
    height = jnp.linspace(-0.08, -0.06, 21)
    position = jnp.stack([jnp.full(21, 0.2), height, jnp.full(21, 0.15)], axis=-1)[:, None]
    poses = Pose(position, jnp.broadcast_to(jnp.eye(3), (21, 1, 3, 3)))
    end = thin.step(scene, state, poses, pins=pins, store_every=5)
    weights = jnp.cos(jnp.arange(end.x.size)).reshape(end.x.shape)
    return jnp.sum(weights * (end.x + 0.1 * end.v))


@pytest.mark.parametrize("law", thin.MembraneLaw)
def test_reverse_is_forward_is_finite_difference_in_contact(x64, agree_along, law):
    contact = PenaltyContact(stiffness=50.0, damping=0.1, friction_damping=0.1, onset=0.01)
    collider = Collider(shape=Sphere(radius=0.1), body=0, friction=0.3)
    scene = cloth_scene(held=[0, 3], law=law, damping=1e-3, contact=contact, colliders=(collider,))
    state = shaken(SHEET, size=0.005)
    pins = jnp.broadcast_to(jnp.asarray(SHEET.vertices)[jnp.array([0, 3])], (20, 2, 3)) + 0.001
    before = Pose(jnp.array([[0.2, -0.08, 0.15]]), jnp.eye(3)[None])
    assert np.abs(thin.contact_force(scene, state, before, before)).max() > 0.1
    args = (scene, state, pins, jnp.asarray(SHEET.vertices))
    rng = np.random.default_rng(1)
    zero = jax.tree.map(jnp.zeros_like, args)
    noise = [jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), a) for a in args[1:]]
    relative = jax.tree.map(lambda a: a * (1.0 + 0.5 * rng.standard_normal(a.shape)), (scene.cloth, scene.contact))
    directions = {
        "material and contact": (zero[0].replace(cloth=relative[0], contact=relative[1]), *zero[1:]),
        "state": (zero[0], noise[0], *zero[2:]),
        "pins": (*zero[:2], noise[1], zero[3]),
        "rest shape": (*zero[:3], noise[2]),
    }
    agree_along(dropped, args, directions, step=1e-6, exact=1e-9, bar=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_float32_is_near_float64(x64, kind):
    scene, mesh = KINDS[kind](damping=1e-4)
    state = shaken(mesh, size=0.005)
    narrow = jax.tree.map(lambda a: a.astype(jnp.float32), (scene, state))
    wide, small = run(scene, state, 200), run(*narrow, 200)
    assert small.x.dtype == jnp.float32
    np.testing.assert_allclose(small.x, wide.x, atol=2e-5)


@NEEDS_COMPILER
def test_every_program_of_a_step_runs_in_cpp():
    contact = PenaltyContact(stiffness=50.0, damping=0.1, friction_damping=0.1)
    ground = Ground(normal=(0.0, 1.0, 0.0))
    for make, mesh in ((cloth_scene, SHEET), (rope_scene, LINE)):
        scene, state = make(contact=contact, ground=ground), thin.initial_state(mesh.vertices)
        poses = thin.static_poses(2)

        def total(scene, state, poses=poses):
            return jnp.sum(thin.step(scene, state, poses).x)

        with recorded() as decisions:
            jax.jit(jax.grad(total, argnums=(0, 1))).lower(scene, state)
        found = {d.function.rsplit(".", 1)[-1] for d in decisions}
        assert found >= (
            {"membrane", "_hinge_turn", "_moment", "_hinge_pull", "_moved"}
            if mesh is SHEET
            else {"_segment", "_bend", "_moved"}
        )
        assert not [d for d in decisions if d.reason], decisions


def test_a_batch_of_materials_and_starts_is_a_loop(x64):
    scene = cloth_scene(damping=1e-4)
    starts = [shaken(SHEET, size=0.005, seed=i) for i in range(3)]
    scenes = [scene.replace(cloth=scene.cloth.replace(bending=b * scene.cloth.bending)) for b in (0.5, 1.0, 2.0)]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *zip(scenes, starts, strict=True))
    poses = thin.static_poses(50, dtype=float)
    batch = jax.jit(jax.vmap(lambda scene, state: thin.step(scene, state, poses)))(*stacked)
    for i, pair in enumerate(zip(scenes, starts, strict=True)):
        np.testing.assert_allclose(batch.x[i], run(*pair, 50).x, atol=1e-13)


def test_a_fresh_state_can_be_donated():
    scene = rope_scene()
    end = jax.jit(thin.step, donate_argnums=1)(scene, thin.initial_state(LINE.vertices), thin.static_poses(2))
    assert np.isfinite(end.x).all()


def test_a_state_of_less_precision_than_the_scene_is_refused(x64):
    scene = rope_scene()
    state = thin.initial_state(jnp.asarray(LINE.vertices, jnp.float32))
    with pytest.raises(ValueError, match="the state has numbers of float32, but the scene or the poses of float64"):
        thin.step(scene, state, thin.static_poses(2))
