"""Cloth and bodies: equal to cloth alone where bodies are prescribed, nothing lost, weights carried, gradients exact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from self_contact_bodies import folded

from rewax.physics import coupling, rigid, thin
from rewax.physics.contact import Collider, Ground, PenaltyContact
from rewax.physics.coupling import articulated, free_body
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box
from rewax.status import Status

MESH = thin.sheet(0.3, 0.3, 6, 6)
MIDDLE = np.array([0.15, 0.0, 0.15])
BORDER = np.flatnonzero((np.abs(MESH.vertices - MIDDLE) > 0.149).any(axis=-1))
GRAVITY = 9.81
HALF = (0.06, 0.03, 0.06)
RUN = jax.jit(coupling.step, static_argnames="store_every")


def cloth_under(**changes):
    """A sheet of 27 g on which a box may fall: (scene, vertices)."""
    law = PenaltyContact(stiffness=50.0, damping=0.1, friction_damping=0.1, friction=0.5, radius=0.004)
    cloth = thin.isotropic_cloth(youngs_modulus=3e5, poissons_ratio=0.3, thickness=1e-3, density=300.0, damping=2e-4)
    box = Collider(shape=Box(half_size=jnp.asarray(HALF)), friction=0.4)
    settings = {
        "mesh": MESH,
        "dt": 2e-4,
        "cloth": cloth,
        "contact": law,
        "colliders": (box,),
        "gravity": (0.0, 0.0, 0.0),
    }
    return thin.make_scene(**(settings | changes)), thin.initial_state(MESH.vertices)


def box_of(mass):
    a, b, c = np.square(HALF)
    moment = mass / 3.0 * jnp.diag(jnp.array([b + c, a + c, a + b]))[None]
    return free_body.Inertia(mass=jnp.asarray([mass]), moment=moment)


def falling(height=0.04, velocity=(0.1, -0.5, 0.05), spin=(1.0, 2.0, -3.0)):
    return free_body.bodies_at_rest(MIDDLE[None] + np.array([[0.003, height, 0.004]])).replace(
        velocity=jnp.asarray([velocity]), angular_velocity=jnp.asarray([spin])
    )


def test_with_prescribed_bodies_it_is_the_step_of_cloth_alone(x64):
    """The same pins, grips, self-contact, ground and moving collider, through both steps."""
    law = thin.SelfContact(thickness=6e-3, stiffness=20.0, damping=0.01, max_speed=0.5, every=4)
    grasp = thin.Grasp(radius=0.1, stiffness=50.0, damping=0.1)
    scene, state = cloth_under(
        held=[0, 6], grasps=(grasp,), self_contact=law, ground=Ground(normal=(0.0, 1.0, 0.0), height=-0.002)
    )
    way = MIDDLE + np.linspace([0.0, 0.034, 0.0], [0.001, 0.033, 0.0], 41)
    poses = Pose(jnp.asarray(way)[:, None], jnp.broadcast_to(jnp.eye(3), (41, 1, 3, 3)))
    state = thin.open_grasps(scene, state, Pose(poses.position[0], poses.rotation[0]))
    pins = jnp.asarray(MESH.vertices)[jnp.array([0, 6])] + jnp.linspace(0.0, 0.003, 40)[:, None, None]
    grips = jnp.linspace(0.2, 1.0, 40)[:, None]
    alone = jax.jit(thin.step)(scene, state, poses, pins=pins, grips=grips)
    none = free_body.Inertia(mass=jnp.zeros(0), moment=jnp.zeros((0, 3, 3)))
    bodies = free_body.bodies_at_rest(jnp.zeros((0, 3)))
    coupled, _, wrench = RUN(scene, none, state, bodies, poses, pins=pins, grips=grips)
    assert float(jnp.abs(coupled.x - state.x).max()) > 1e-3 and float(jnp.abs(wrench.force).max()) > 0.1
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), coupled, alone)


@pytest.mark.parametrize("mass", [0.1, 1e-3, 1e-6])
def test_momentum_of_cloth_and_body_is_conserved_to_rounding(x64, mass):
    """Contact and a closing grasp between a cloth of 27 g and a box that is heavier, lighter, and a millionth."""
    scene, state = cloth_under(grasps=(thin.Grasp(radius=0.12, stiffness=40.0, damping=0.1),))
    inertia, bodies = box_of(mass), falling(height=0.036)

    def total(state, bodies):
        linear = thin.momentum(scene, state) + free_body.momentum(bodies, inertia)
        return linear, thin.angular_momentum(scene, state) + free_body.angular_momentum(bodies, inertia)

    state = thin.open_grasps(scene, state, free_body.poses(bodies))
    before, received = total(state, bodies), 0.0
    for grip in (0.0, 0.5, 1.0, 0.2):
        state, bodies, wrench = RUN(
            scene, inertia, state, bodies, thin.static_poses(100, dtype=float), grips=jnp.array([grip])
        )
        received = received + wrench.force[0] * 100 * scene.dt
    for found, expected in zip(total(state, bodies), before, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    change = mass * (bodies.velocity - falling().velocity)[0]
    assert float(jnp.abs(change).max()) > 0.05 * mass
    np.testing.assert_allclose(received, change, atol=1e-12)


def test_a_held_sheet_carries_the_weight_of_a_box(x64):
    """At rest the sheet's force on the box is the box's weight."""
    scene, state = cloth_under(held=BORDER, gravity=(0.0, -GRAVITY, 0.0), drag=150.0)
    mass, inertia = 0.05, box_of(0.05)
    bodies = free_body.bodies_at_rest(jnp.asarray(MIDDLE[None] + np.array([[0.0, 0.034, 0.0]])))
    for _ in range(20):
        state, bodies, wrench = RUN(scene, inertia, state, bodies, thin.static_poses(500, dtype=float))
    np.testing.assert_allclose(wrench.force[0], [0.0, mass * GRAVITY, 0.0], atol=1e-4 * mass * GRAVITY)
    assert float(jnp.abs(bodies.velocity).max()) < 1e-4 and 0.0 < float(bodies.position[0, 1]) < 0.02


# --- Robots -----------------------------------------------------------------------------------------------------------

ARM = """
<mujoco><option gravity="0 {gravity} 0"/><worldbody>
  <body name="hand" pos=".15 .05 .15"><joint name="lift" type="slide" axis="0 1 0" stiffness="20" damping="4"/>
    <joint name="turn" axis="0 1 0" damping=".01"/>
    <geom type="box" size=".02 .02 .02" mass=".1" contype="0" conaffinity="1" friction=".4"/>
  </body>
</worldbody><actuator><motor joint="lift"/><motor joint="turn" gear=".01"/></actuator></mujoco>
"""


def robot_with_cloth(gravity=0.0, **changes):
    model = rigid.load(ARM.format(gravity=gravity), dt=4e-4)
    grasp = thin.Grasp(radius=0.09, stiffness=50.0, damping=0.1, offset=(0.0, -0.05, 0.0), body=1)
    settings = {"grasps": (grasp,), "colliders": rigid.colliders(model), "gravity": (0.0, gravity, 0.0)}
    scene, state = cloth_under(**(settings | changes))
    robot = rigid.initial_state(model)
    return model, scene, thin.open_grasps(scene, state, rigid.body_poses(model, robot)), robot


@pytest.mark.slow
def test_a_hand_feels_the_weight_of_the_cloth_that_it_holds(x64):
    """The spring of the lift carries hand and cloth; once the hand opens, the hand alone."""
    model, scene, state, robot = robot_with_cloth(-GRAVITY, drag=30.0)
    step = jax.jit(articulated.step, static_argnames="num_substeps")
    for _ in range(10):
        state, robot, wrench = step(scene, model, state, robot, grips=jnp.ones(1), num_substeps=500)
    weight = GRAVITY * float(scene.mass.sum())
    np.testing.assert_allclose(float(robot.qpos[0]), -(0.1 * GRAVITY + weight) / 20.0, rtol=2e-3)
    np.testing.assert_allclose(wrench.force[1], [0.0, -weight, 0.0], atol=0.02 * weight)
    for _ in range(4):
        state, robot, wrench = step(scene, model, state, robot, grips=jnp.zeros(1), num_substeps=500)
    np.testing.assert_allclose(float(robot.qpos[0]), -0.1 * GRAVITY / 20.0, rtol=1e-2)
    np.testing.assert_allclose(wrench.force[1], 0.0, atol=1e-12)


def pushed(scene, model, state, robot, ctrl, grips):
    """A number from 16 substeps of a cloth that a hand touches, holds, lifts and turns."""
    state, robot, wrench = articulated.step(scene, model, state, robot, ctrl, grips=grips[:, None], num_substeps=8)
    weights = jnp.cos(jnp.arange(state.x.size)).reshape(state.x.shape)
    return jnp.sum(weights * (state.x + 0.01 * state.v)) + robot.qvel @ jnp.array([1.0, 0.3]) + wrench.force[1, 1]


def test_reverse_is_forward_is_finite_difference_through_a_robot(x64):
    model, scene, state, robot = robot_with_cloth()
    robot = robot.replace(qpos=jnp.array([-0.0275, 0.1]), qvel=jnp.array([-0.2, 0.5]))  # the hand touches the cloth
    rng = np.random.default_rng(0)
    state = state.replace(v=0.1 * jnp.asarray(rng.standard_normal(state.v.shape)))
    args = (scene, model, state, robot, jnp.array([0.5, 1.0]), jnp.linspace(0.1, 0.9, 16))
    slopes = jax.jit(jax.grad(pushed, argnums=(0, 2, 3, 4, 5)))(*args)
    value = jax.jit(pushed)

    def along(arguments, directions, size):
        moved = jax.tree.map(lambda a, d: a + size * d, (arguments[0], *arguments[2:]), directions)
        return value(moved[0], model, *moved[1:])

    @jax.jit
    def forward(directions):
        def line(size):
            moved = jax.tree.map(lambda a, d: a + size * d, (scene, *args[2:]), directions)
            return pushed(moved[0], model, *moved[1:])

        return jax.jvp(line, (jnp.zeros(()),), (jnp.ones(()),))[1]

    zero = jax.tree.map(jnp.zeros_like, (scene, *args[2:]))
    noise = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(jnp.shape(a))), args[2:])
    law = jax.tree.map(lambda a: 0.1 * a, (scene.grasps, scene.contact))
    for name, direction in {
        "grasp and contact law": (zero[0].replace(grasps=law[0], contact=law[1]), *zero[1:]),
        "cloth": (zero[0], noise[0], *zero[2:]),
        "joints": (*zero[:2], zero[2].replace(qpos=noise[1].qpos, qvel=noise[1].qvel), *zero[3:]),
        "controls": (*zero[:3], noise[2], zero[4]),
        "grips": (*zero[:4], noise[3]),
    }.items():
        reverse = sum(float(jnp.sum(a * b)) for a, b in zip(*map(jax.tree.leaves, (slopes, direction)), strict=True))
        difference = float(along(args, direction, 1e-6) - along(args, direction, -1e-6)) / 2e-6
        assert abs(reverse) > 1e-6, name
        np.testing.assert_allclose(reverse, forward(direction), rtol=1e-8, err_msg=name)
        np.testing.assert_allclose(reverse, difference, rtol=1e-4, err_msg=name)


def test_a_coupled_step_remembers_full_lists_and_fast_vertices(x64):
    """The step ends where nothing is close or fast, so that only what was remembered can tell."""
    scene, state = folded()
    few = scene.replace(self_contact=scene.self_contact.replace(pairs_per_element=1, max_speed=100.0))
    fast = state.replace(v=state.v.at[0, 1].set(2.0))
    run, poses = jax.jit(coupling.step_prescribed), thin.static_poses(8, dtype=float)
    flat = jnp.asarray(thin.sheet(0.4, 0.2, 8, 4).vertices)
    for own, start, bit in ((few, state, Status.FULL_PAIRS), (scene, fast, Status.CROSSED)):
        end = run(own, start, poses).replace(x=flat, v=jnp.zeros_like(flat))
        assert thin.check_status(scene, end) & bit
        assert thin.check_status(scene, run(scene, end, poses)) & bit
