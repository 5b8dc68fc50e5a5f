"""Grasps: carry, release, slip, refuse illegal values, derivatives by action."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import SHEET, STEP, cloth_scene, shaken

from rewax.physics import thin
from rewax.physics.contact import Collider, PenaltyContact
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Sphere
from rewax.physics.thin.grasps import check_grasps
from rewax.status import Status

CORNER = np.asarray(SHEET.vertices[0])


def gripper(**changes):
    return thin.Grasp(**({"radius": 0.08, "stiffness": 500.0, "damping": 0.5} | changes))


def poses_along(way, turn=None):
    """Poses of one body at positions (n, 3), at rest or turned about y by angles (n,)."""
    angle = jnp.zeros(len(way)) if turn is None else turn
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    rows = [jnp.stack(row, axis=-1) for row in ((c, zero, s), (zero, one, zero), (-s, zero, c))]
    return Pose(way[:, None], jnp.stack(rows, axis=-2)[:, None])


def at(poses, k):
    return jax.tree.map(lambda a: a[k], poses)


def still(num, position=CORNER):
    return poses_along(jnp.broadcast_to(position, (num + 1, 3)))


def opened(scene, poses, state=None):
    return thin.open_grasps(scene, thin.initial_state(SHEET.vertices) if state is None else state, at(poses, 0))


def test_a_closed_grasp_carries_a_corner_and_an_open_one_does_not(x64):
    scene = cloth_scene(grasps=(gripper(),), damping=1e-3, drag=2.0)
    way = CORNER + jnp.linspace(0.0, 0.05, 501)[:, None] * jnp.array([0.0, 1.0, 0.0])
    poses = poses_along(way)
    state = opened(scene, poses)
    carried, left = (STEP(scene, state, poses, grips=jnp.array([g])) for g in (1.0, 0.0))
    np.testing.assert_allclose(carried.x[0], way[-1], atol=2e-3)
    np.testing.assert_allclose(left.x, SHEET.vertices, atol=1e-12)
    assert int(thin.check_status(scene, carried)) == 0


def test_the_force_of_a_closed_grasp_is_that_of_its_springs(x64):
    """A weight at rest stretches the springs by m g / k: the held rigid patch hangs below the hand."""
    grasp = thin.Grasp(vertices=range(len(SHEET.vertices)), stiffness=200.0, damping=1.0)
    scene = cloth_scene(grasps=(grasp,), gravity=(0.0, -9.81, 0.0), damping=1e-3)
    end = STEP(scene, opened(scene, still(3000)), still(3000), grips=jnp.array([1.0]))
    x = np.asarray(end.x) - SHEET.vertices
    pull = 200.0 * x[:, 1].sum()  # springs of one stiffness: their sum carries the weight
    np.testing.assert_allclose(-pull, 9.81 * scene.mass.sum(), rtol=1e-6)


def test_held_vertices_turn_with_the_body(x64):
    scene = cloth_scene(grasps=(thin.Grasp(vertices=[0, 1, 5, 6], stiffness=800.0, damping=1.0),), damping=1e-3)
    turn = jnp.linspace(0.0, 0.3, 1501)
    poses = poses_along(jnp.broadcast_to(CORNER, (1501, 3)), turn)
    end = STEP(scene, opened(scene, poses), poses, grips=jnp.array([1.0]))
    expected = CORNER + (SHEET.vertices[[0, 1, 5, 6]] - CORNER) @ np.asarray(at(poses, -1).rotation[0]).T
    np.testing.assert_allclose(np.asarray(end.x)[[0, 1, 5, 6]], expected, atol=2e-3)


def test_the_grasp_closes_on_what_is_within_its_radius_at_that_moment(x64):
    """The hand passes over the sheet with open fingers, and closes over another vertex."""
    scene = cloth_scene(grasps=(gripper(),))
    goal = jnp.asarray(SHEET.vertices[12])
    poses = poses_along(CORNER + jnp.linspace(0.0, 1.0, 2001)[:, None] * (goal - CORNER))
    there = STEP(scene, opened(scene, poses), poses, grips=jnp.zeros(1))
    hold = there.holds[0]
    distance = np.linalg.norm(SHEET.vertices - np.asarray(goal), axis=-1)
    np.testing.assert_allclose(hold.share[distance < 0.04], 1.0, atol=1e-3)
    np.testing.assert_allclose(hold.share[distance > 0.08], 0.0, atol=1e-3)
    np.testing.assert_allclose(hold.point, SHEET.vertices - np.asarray(goal), atol=1e-3)  # speed times slip_time
    lifted = STEP(scene, there, poses_along(goal + jnp.linspace(0.0, 0.03, 501)[:, None] * jnp.array([0.0, 1.0, 0.0])),
                  grips=jnp.ones(1))  # fmt: skip
    assert float(lifted.x[12, 1]) > 0.025 > 0.01 > float(lifted.x[0, 1])


def test_a_half_closed_grasp_slips_and_a_closed_one_keeps_its_points(x64):
    """da/dt = (1 - g)^4 / slip_time (R^T (x - p) - a), exactly, for held vertices that do not move."""
    scene = cloth_scene(grasps=(gripper(),), held=range(len(SHEET.vertices)))
    away = still(100, CORNER + 0.01)
    state = opened(scene, still(1))
    for grip in (0.0, 0.5, 0.9, 1.0):
        end = STEP(scene, state, away, grips=jnp.array([grip]))
        left = np.exp(-((1 - grip) ** 4) * 100 * scene.dt / 1e-3)
        np.testing.assert_allclose(end.holds[0].point - state.holds[0].point, -0.01 * (1 - left), rtol=1e-9, atol=1e-15)
        np.testing.assert_array_equal(end.x, SHEET.vertices)


def test_scenes_and_steps_refuse_what_is_illegal(x64):
    for wrong, message in (
        (thin.Grasp(stiffness=1.0), "neither radius nor vertices"),
        (thin.Grasp(radius=-1.0, stiffness=1.0), r"grasps\[0\].radius is -1.0"),
        (thin.Grasp(vertices=[99], stiffness=1.0), r"grasps\[0\].vertices has indices"),
        (thin.Grasp(radius=0.1, stiffness=1e9), "above the largest stable"),
    ):
        with pytest.raises(ValueError, match=message):
            cloth_scene(grasps=(wrong,))
    scene, poses = cloth_scene(grasps=(gripper(),)), still(4)
    plain = thin.initial_state(SHEET.vertices)
    for state, bodies, grips, message in (
        (plain, poses, jnp.ones(1), "begin with thin.open_grasps"),
        (opened(scene, poses), poses, None, "grips has shape None"),
        (opened(scene, poses), poses, jnp.ones((3, 1)), r"grips has shape \(3, 1\)"),
        (opened(scene, poses), thin.static_poses(4), jnp.ones(1), "belongs to body 0"),
    ):
        with pytest.raises(ValueError, match=message):
            thin.step(scene, state, bodies, grips=grips)
    nowhere = at(thin.static_poses(4), 0)
    with pytest.raises(ValueError, match=r"grasps\[0\] belongs to body 0, but there are poses of 0 bodies"):
        thin.open_grasps(scene, plain, nowhere)
    ball = Collider(shape=Sphere(radius=0.1), friction=0.0)
    touched = cloth_scene(colliders=(ball,), contact=PenaltyContact(stiffness=1.0))
    with pytest.raises(ValueError, match="collider 0 belongs to body 0, but there are poses of 0 bodies"):
        thin.contact_force(touched, plain, nowhere, nowhere)
    broken = scene.replace(grasps=(gripper(radius=jnp.float64(-1.0)),))
    assert int(thin.check_status(broken, plain)) & Status.INVALID_PARAMETERS


def carried(scene, state, way, turn, grips):
    """A number from a cloth that a turning hand grasps, carries and lets go."""
    poses = poses_along(way, turn)
    end = thin.step(scene, state, poses, grips=grips[:, None], store_every=5)
    weights = jnp.cos(jnp.arange(end.x.size)).reshape(end.x.shape)
    return jnp.sum(weights * (end.x + 0.01 * end.v)) + jnp.sum(end.holds[0].share)


def test_reverse_is_forward_is_finite_difference(x64, agree_along):
    grasp = thin.Grasp(radius=0.15, stiffness=500.0, damping=0.5, offset=(0.01, 0.0, 0.02))
    scene = cloth_scene(grasps=(grasp,), held=[19], damping=1e-3)
    rng = np.random.default_rng(2)
    way = CORNER + 0.002 * jnp.cumsum(jnp.asarray(rng.standard_normal((31, 3))), axis=0)
    turn = 0.01 * jnp.cumsum(jnp.asarray(rng.standard_normal(31)))
    grips = jnp.concatenate([jnp.linspace(0.05, 1.0, 10), jnp.ones(10), jnp.linspace(0.95, 0.3, 10)])
    state = thin.open_grasps(scene, shaken(SHEET, size=0.005), at(poses_along(way, turn), 0))
    args = (scene, state, way, turn, grips)
    zero = jax.tree.map(jnp.zeros_like, args)
    noise = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), args[1:])
    moved = jax.tree.map(lambda a: 0.1 * a, scene.grasps)
    inner = noise[3].at[10:20].set(-jnp.abs(noise[3][10:20]))  # a grip beyond 1 counts as 1
    directions = {
        "grasp": (zero[0].replace(grasps=moved), *zero[1:]),
        "state and holds": (zero[0], noise[0], *zero[2:]),
        "position": (*zero[:2], noise[1], *zero[3:]),
        "turn": (*zero[:3], noise[2], zero[4]),
        "grip": (*zero[:4], inner.at[9:20].set(0.0)),
    }
    agree_along(carried, args, directions, step=1e-6, exact=1e-9, bar=1e-5)


def test_the_grip_has_a_slope_at_both_ends(x64):
    """An open hand that moves along learns that closing drags the cloth; a closed one, that opening lets it slip."""
    scene = cloth_scene(grasps=(gripper(),), drag=2.0)
    way = CORNER + jnp.linspace(0.0, 0.02, 101)[:, None] * jnp.array([0.0, 1.0, 0.0])
    poses = poses_along(way)
    state = opened(scene, poses)
    height = jax.jit(lambda grip: thin.step(scene, state, poses, grips=grip).x[0, 1])
    for grip, side in ((0.0, 1.0), (1.0, -1.0)):
        slope = float(jax.grad(height)(jnp.array([grip]))[0])
        difference = float(height(jnp.array([grip + side * 1e-6])) - height(jnp.array([grip]))) / (side * 1e-6)
        assert abs(slope) > 1e-5
        np.testing.assert_allclose(slope, difference, rtol=1e-3)


def test_vertices_are_indices_or_a_mask():
    mask = np.array([True, False, True])
    assert thin.Grasp(stiffness=1.0, vertices=mask).vertices == (0, 2)
    for vertices in ((0.5, 1.0), (1, 1), (-1,)):
        with pytest.raises(ValueError, match=r"^vertices"):
            thin.Grasp(stiffness=1.0, vertices=vertices)
    for nothing in (np.zeros(3, bool), ()):
        with pytest.raises(ValueError, match=r"^Grasp.vertices holds no vertex"):
            thin.Grasp(stiffness=1.0, vertices=nothing)
    grasp = thin.Grasp(stiffness=1.0, vertices=mask).replace(body=1)
    check_grasps((grasp,), 3)
    with pytest.raises(ValueError, match=r"^grasps\[0\].vertices is a mask of length 3, but the scene has 25 vertices"):
        check_grasps((grasp,), 25)
