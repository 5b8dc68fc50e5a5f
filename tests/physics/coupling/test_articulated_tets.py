"""Tetrahedra and robots: equal to a free body where both can do it, nothing lost, light fingers calm, exact gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import coupling, rigid, tets
from rewax.physics.contact import WALLS, Ground, Patches, PenaltyContact
from rewax.physics.coupling import articulated, free_body
from rewax.physics.tets import DampingLaw, tetmesh

DT = 5e-4
MESH = tetmesh.box((0.16, 0.08, 0.16), (4, 2, 4), tets_per_cell=5)
CLAW = """
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="palm" pos=".003 .085 .002"><freejoint/>
    <geom type="sphere" size=".04" mass=".3" friction=".4" contype="0" conaffinity="1"/>
    {finger}
  </body>
</worldbody>{motor}</mujoco>
"""
FINGER = """
<body name="finger" pos=".045 .01 0"><joint name="bend" axis="0 0 1" damping="1e-4"/>
  <geom type="capsule" fromto="0 0 0 0 -.05 0" size=".008" mass=".03" friction=".4" contype="0" conaffinity="1"/>
</body>
"""
MOTOR = '<actuator><motor joint="bend" gear=".002"/></actuator>'


def claw(finger=FINGER, dt=DT):
    motor = MOTOR if finger else ""
    return rigid.load(CLAW.format(finger=finger, motor=motor), dt=dt)


def block_under(model, height=-1.0):
    law = PenaltyContact(stiffness=1e3, damping=1.0, friction_damping=2.0, friction=0.5, radius=0.005)
    scene = tets.make_scene(
        mesh=MESH, density=1000.0, mu=2e4, lam=3e4, dt=DT, damping=5.0, damping_law=DampingLaw.STRAIN_RATE, contact=law,
        gravity=(0.0, 0.0, 0.0), ground=Ground(normal=jnp.array([0.0, 1.0, 0.0]), height=height),
        colliders=rigid.colliders(model),
    )  # fmt: skip
    return jax.tree.map(lambda a: jnp.asarray(a, float), scene), tets.initial_state(MESH.vertices)


def thrown(model, velocity=(0.02, -0.4, 0.01), spin=(1.0, 2.0, -3.0)):
    qvel = jnp.zeros(model.num_dofs).at[:6].set(jnp.asarray([*velocity, *spin]))
    return rigid.initial_state(model, qvel=qvel)


RUN = jax.jit(articulated.step, static_argnames="num_substeps")


@pytest.mark.slow
def test_a_model_of_one_free_body_does_what_a_free_body_does(x64):
    model = claw(finger="")
    scene, state = block_under(model)
    robot = thrown(model)
    inertia = free_body.Inertia(mass=jnp.asarray([0.3]), moment=0.4 * 0.3 * 0.04**2 * jnp.eye(3)[None])
    ball = scene.replace(colliders=tuple(c.replace(body=0) for c in scene.colliders))
    body = free_body.bodies_at_rest(robot.qpos[None, :3]).replace(
        velocity=robot.qvel[None, :3], angular_velocity=robot.qvel[None, 3:]
    )
    vertices, robot, wrench = RUN(scene, model, state, robot, num_substeps=100)
    others, body, push = jax.jit(coupling.step)(ball, inertia, state, body, tets.static_poses(100))
    assert float(push.force[0, 1]) > 1.0
    np.testing.assert_allclose(vertices.x, others.x, atol=1e-8)
    np.testing.assert_allclose(robot.qpos[:3], body.position[0], atol=1e-9)
    np.testing.assert_allclose(robot.qvel[:3], body.velocity[0], atol=1e-7)
    np.testing.assert_allclose(wrench.force[1], push.force[0], atol=1e-5)
    np.testing.assert_allclose(wrench.torque[1], push.torque[0], atol=1e-5)


@pytest.fixture(scope="module")
def once():
    """``once(scene, model, vertices, robot, ctrl)``: one substep of the robot, compiled once for each length."""
    return jax.jit(articulated.step)


def test_what_tets_lose_robots_get(x64, once):
    """Torques are about the frames' origins. A robot's substep may last two of the tets: it ends nearly alike."""
    ends = []
    for each in (1, 2):
        model = claw(dt=each * DT)
        scene, state = block_under(model)
        assert articulated.soft_substeps(scene, model) == each
        robot, given, turned = thrown(model), jnp.zeros((3, 3)), jnp.zeros(3)
        for _ in range(80 // each):
            position = rigid.body_poses(model, robot).position
            state, robot, wrench = once(scene, model, state, robot, jnp.array([-1.0]))
            given = given + model.dt * wrench.force
            turned = turned + model.dt * (wrench.torque + jnp.cross(position, wrench.force)).sum(0)
        lost = -tets.momentum(scene, state)
        assert np.abs(np.asarray(given)[1:]).max(axis=1).min() > 1e-4  # palm and finger both touched
        np.testing.assert_allclose(given.sum(0), lost, atol=1e-12)
        if each == 1:  # else the origins move between the tets' substeps
            about = -tets.angular_momentum(scene, state)
            np.testing.assert_allclose(turned, about, atol=1e-9 * float(jnp.abs(about).max()))
        ends.append(np.asarray(robot.qpos))
    assert 0.0 < np.abs(ends[1] - ends[0]).max() < 2e-3


@pytest.mark.parametrize("mass", [1e-2, 1e-4, 1e-6])
def test_a_light_finger_is_calm(x64, once, mass):
    """Thrown on the block, pressed on it, and bent into it by a motor: no mass makes it or the vertices fast."""
    model = claw()
    lighter = jnp.ones(3).at[2].set(mass / 0.03)
    own = {name: model.parameters[name] for name in ("body_mass", "body_inertia")}
    own = {name: (a.T * lighter).T for name, a in own.items()}
    model = model.replace(parameters={**model.parameters, **own}, gravity=jnp.array([0.0, -9.81, 0.0]))
    scene, state = block_under(model, height=-0.045)
    robot = thrown(model, velocity=(0.0, -0.2, 0.0), spin=(0.0, 0.0, 0.0))
    fastest = []
    for _ in range(400):
        state, robot, wrench = once(scene, model, state, robot, jnp.array([-1.0]))
        fastest.append([float(jnp.abs(a).max()) for a in (state.v, robot.qvel[:3], robot.qvel[6])])
    assert np.all(np.max(fastest, axis=0) < [0.6, 0.5, 150.0])  # alone, the motor turns the finger at 20 rad/s
    assert float(wrench.force[1, 1]) > 1.0  # the block carries it
    assert int(tets.check_status(scene, state)) == 0


@pytest.mark.slow
def test_gradients_are_those_of_differences(x64):
    """By throw, motor and stiffness; reverse equals forward; two substeps of the tets in one of the robot."""
    upright = CLAW.replace("<freejoint/>", '<joint type="slide" axis="0 1 0"/>')
    model = rigid.load(upright.format(finger=FINGER, motor=MOTOR), dt=2 * DT)
    scene, state = block_under(model)
    state = state.replace(v=0.02 * jnp.asarray(np.random.default_rng(0).normal(size=state.v.shape)))

    def end(p):
        robot = rigid.initial_state(model, qvel=p["throw"])
        after, robot, wrench = articulated.step(
            scene.replace(mu=2e4 * p["stiffness"]), model, state, robot, p["ctrl"], num_substeps=10
        )
        return (
            jnp.sum(jnp.sin(40 * after.x)) + jnp.sum(robot.qpos * jnp.array([1.0, 2.0])) + 0.1 * jnp.sum(wrench.torque)
        )

    point = {
        "throw": jnp.array([-0.4, 1.0]),
        "ctrl": jnp.array([0.5]),
        "stiffness": jnp.asarray(1.0),
    }
    slope = jax.jit(jax.grad(end))(point)
    forward = jax.jit(lambda p, d: jax.jvp(end, (p,), (d,)))
    for k in range(3):
        keys = jax.random.split(jax.random.key(k), 3)
        along = {n: jax.random.normal(key, a.shape) for key, (n, a) in zip(keys, point.items(), strict=True)}
        h = 1e-7
        ahead, behind = (
            forward(jax.tree.map(lambda a, d, s=s: a + s * h * d, point, along), along)[0] for s in (1, -1)
        )
        found = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(along), strict=True))
        np.testing.assert_allclose(forward(point, along)[1], found, rtol=1e-9)
        np.testing.assert_allclose((ahead - behind) / (2 * h), found, rtol=1e-5)
    assert all(float(jnp.abs(a).max()) > 1e-4 for a in slope.values())


def test_patches_feel_the_wrenches_of_their_bodies_and_the_ground_the_rest(x64):
    model = claw()
    scene, state = block_under(model, height=-0.039)
    felt_step = jax.jit(articulated.step_with_touch, static_argnames="num_substeps")
    patches = Patches(body=(1, 2, WALLS))
    after, _, wrench, felt = felt_step(scene, model, state, thrown(model), patches=patches, num_substeps=20)
    for found, body in zip(felt, wrench, strict=True):
        np.testing.assert_allclose(found[:2], body[1:], atol=1e-9)
    change = scene.mass @ (after.v - state.v) / (20 * DT)
    np.testing.assert_allclose(felt.force.sum(0), -change, atol=1e-8)
    assert np.abs(felt.force).max(axis=1).min() > 1e-3
