"""Particles and robots: equal to a free body where both can do it, momentum kept, light fingers calm, exact gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material

from rewax.physics import coupling, mpm, rigid, tets
from rewax.physics.contact import WALLS, Patches
from rewax.physics.coupling import articulated, free_body
from rewax.physics.mpm import Grid, VonMises, Wall, WallKind, Walls, invariants
from rewax.physics.shapes.sampling import fill_box
from rewax.physics.tets import tetmesh
from rewax.struct import replace_leaf

SPACING = 0.02
FLOATING = """
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="box" pos=".1 .21 .1"><freejoint/>
    <geom name="box" type="box" size=".03 .02 .03" mass=".3" friction=".4" contype="0" conaffinity="1"/>
    {finger}
  </body>
</worldbody></mujoco>
"""
FINGER = """
<body name="finger" pos=".02 -.02 0"><joint name="bend" axis="0 0 1" damping="1e-4"/>
  <geom type="capsule" fromto="0 0 0 0 -.05 0" size=".008" mass="{mass}" friction=".4" contype="0" conaffinity="1"/>
</body>
"""


def model_of(finger="", dt=4e-4):
    return rigid.load(FLOATING.format(finger=finger), dt=dt)


def dough_under(model, *, walls=False, dt=4e-4):
    x = fill_box((0.1, 0.16, 0.1), (0.08, 0.04, 0.08), 0.5 * SPACING)
    floor = Walls(lower=(None, Wall(position=0.1401, kind=WallKind.GRIPPING), None), upper=(None,) * 3)
    scene = mpm.make_scene(
        grid=Grid(shape=(11, 15, 11), spacing=SPACING), dt=dt, gravity=(0.0, 0.0, 0.0),
        particle_volume=jnp.asarray(0.08 * 0.04 * 0.08 / len(x)),
        material=flat_material(youngs_modulus=5e3, poissons_ratio=0.3, yield_stress=200.0, plasticity=VonMises),
        colliders=rigid.colliders(model, softness=200.0), **({"walls": floor} if walls else {}),
    )  # fmt: skip
    return scene, mpm.initial_state(jnp.asarray(x, jnp.result_type(float)), scene)


def thrown(model, velocity=(0.02, -0.4, 0.01), spin=(1.0, 2.0, -3.0)):
    qvel = jnp.zeros(model.num_dofs).at[:6].set(jnp.asarray([*velocity, *spin]))
    return rigid.initial_state(model, qvel=qvel)


RUN = jax.jit(articulated.step, static_argnames="num_substeps")


def test_a_model_of_one_free_body_does_what_a_free_body_does():
    model = model_of()
    scene, state = dough_under(model)
    robot = thrown(model)
    moment = 0.3 * jnp.diag(jnp.array([0.02**2 + 0.03**2, 2 * 0.03**2, 0.02**2 + 0.03**2])) / 3.0
    inertia = free_body.Inertia(mass=jnp.asarray([0.3]), moment=moment[None])
    box = scene.replace(colliders=tuple(c.replace(body=0) for c in scene.colliders))
    body = free_body.bodies_at_rest([[0.1, 0.21, 0.1]]).replace(
        velocity=robot.qvel[None, :3], angular_velocity=robot.qvel[None, 3:]
    )
    particles, robot, wrench = RUN(scene, model, state, robot, num_substeps=100)
    others, body, push = jax.jit(coupling.step)(box, inertia, state, body, mpm.static_poses(100))
    np.testing.assert_allclose(particles.x, others.x, atol=1e-5)
    np.testing.assert_allclose(robot.qpos[:3], body.position[0], atol=1e-6)
    np.testing.assert_allclose(robot.qvel[:3], body.velocity[0], atol=1e-4)
    for found, expected in ((wrench.force[1], push.force[0]), (wrench.torque[1], push.torque[0])):
        np.testing.assert_allclose(found, expected, atol=0.02 * float(jnp.abs(expected).max()))


def momentum(model, scene, state, robot):
    """Linear momentum of particles and robot [kg m/s]."""
    velocity, spin = rigid.body_velocities(model, robot)
    poses = rigid.body_poses(model, robot)
    arm = jnp.einsum("bij,bj->bi", poses.rotation, model.parameters["body_ipos"])
    own = model.parameters["body_mass"][:, None] * (velocity + jnp.cross(spin, arm))
    return np.asarray(invariants.momentum(scene, state) + own.sum(0))


@pytest.mark.parametrize("mass", [pytest.param(0.03, marks=pytest.mark.slow), 0.0005])
def test_momentum_of_particles_and_robot_is_conserved(x64, mass):
    """The robot's own integrator turns its links by a whole substep at a time: that is all that is lost."""
    drifts = []
    for dt in (4e-4, 2e-4):
        model = model_of(FINGER.format(mass=mass), dt=dt)
        scene, state = dough_under(model, dt=dt)
        robot = thrown(model)
        before = momentum(model, scene, state, robot)
        state, robot, _ = RUN(scene, model, state, robot, num_substeps=round(0.08 / dt))
        drifts.append(np.abs(momentum(model, scene, state, robot) - before).max() / np.abs(before).max())
        assert float(jnp.abs(state.v).max()) > 0.05  # the dough took some
    assert drifts[0] < 5e-3 and drifts[1] < 0.7 * drifts[0]


def test_what_particles_lose_bodies_get(x64):
    model = model_of(FINGER.format(mass=0.03))
    scene, state = dough_under(model)
    after, _, wrench = RUN(scene, model, state, thrown(model), num_substeps=50)
    lost = invariants.momentum(scene, state) - invariants.momentum(scene, after)
    np.testing.assert_allclose(50 * scene.dt * wrench.force.sum(0), lost, atol=1e-10)


def test_torques_are_about_the_frames_origins(x64):
    """In one substep the wrenches on all bodies take the angular momentum that the particles lose."""
    model = model_of(FINGER.format(mass=0.03))
    scene, state = dough_under(model)
    state, robot, _ = RUN(scene, model, state, thrown(model), num_substeps=50)
    after, _, wrench = RUN(scene, model, state, robot, num_substeps=1)
    lost = invariants.angular_momentum(scene, state) - invariants.angular_momentum(scene, after)
    position = rigid.body_poses(model, robot).position
    given = scene.dt * (wrench.torque + jnp.cross(position, wrench.force)).sum(0)
    np.testing.assert_allclose(given, lost, atol=1e-3 * float(jnp.abs(lost).max()))


def test_patches_feel_the_wrenches_of_their_bodies_and_walls_the_rest(x64):
    model = model_of(FINGER.format(mass=0.03))
    scene, state = dough_under(model, walls=True)
    scene, state = scene.replace(gravity=jnp.array([0.0, -9.81, 0.0])), state.replace(v=state.v - 0.1)
    halves = Patches(body=(1, 1), center=[[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0]])
    patches = {"whole": Patches(body=(1, 2, WALLS)), "halves": halves}
    felt_step = jax.jit(articulated.step_with_touch, static_argnames="num_substeps")
    after, robot, wrench, felt = felt_step(scene, model, state, thrown(model), patches=patches, num_substeps=50)
    expected = RUN(scene, model, state, thrown(model), num_substeps=50)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-10), (after, robot, wrench), expected)
    for found, body in zip(felt["whole"], wrench, strict=True):
        np.testing.assert_allclose(found[:2], body[1:], atol=1e-9)
    for found, body in zip(felt["halves"], wrench, strict=True):
        np.testing.assert_allclose(found.sum(0), body[1], atol=1e-9)
    mass = 1000.0 * 0.08 * 0.04 * 0.08
    change = (invariants.momentum(scene, after) - invariants.momentum(scene, state)) / (50 * scene.dt)
    np.testing.assert_allclose(felt["whole"].force.sum(0), mass * scene.gravity - change, atol=1e-8)
    assert felt["whole"].force[2, 1] < -0.1


@pytest.mark.parametrize("mass", [*(pytest.param(mass, marks=pytest.mark.slow) for mass in (1e-2, 1e-4)), 1e-6])
def test_a_light_finger_in_heavy_dough_is_calm(x64, mass):
    """Pressed into the dough by its weight: no mass makes it or the dough fast."""
    model = model_of(FINGER.format(mass=mass))
    scene, state = dough_under(model, walls=True)
    robot = thrown(model, velocity=(0.0, -0.2, 0.0), spin=(0.0, 0.0, 0.0))
    for _ in range(4):
        state, robot, _ = RUN(scene, model, state, robot, num_substeps=50)
    assert np.isfinite(np.asarray(state.x)).all()
    assert float(jnp.abs(state.v).max()) < 0.5 and float(jnp.abs(robot.qvel[:3]).max()) < 0.4
    assert int(mpm.check_status(scene, state)) == 0


@pytest.mark.slow
def test_a_robots_substep_may_last_several_of_the_particles(x64):
    """Four of them against one: the difference is that of the robot's own forces, first order in its substep."""
    ends = []
    for each in (1, 2, 4):
        model = model_of(FINGER.format(mass=0.03), dt=each * 2e-4)
        scene, state = dough_under(model, dt=2e-4)
        assert articulated.soft_substeps(scene, model) == each
        _, robot, _ = RUN(scene, model, state, thrown(model), num_substeps=200 // each)
        ends.append(np.asarray(robot.qpos))
    assert np.abs(ends[2] - ends[0]).max() < 2e-3
    assert 0.2 < np.abs(ends[1] - ends[0]).max() / np.abs(ends[2] - ends[0]).max() < 0.6


SPRING = """<mujoco><option gravity="0 0 0"/><worldbody><body>
  <joint type="slide" axis="1 0 0" stiffness="100"/><geom type="sphere" size=".02" mass=".01"/>
  <body pos=".1 0 0"><joint type="ball" stiffness=".1"/><geom type="box" size=".02 .03 .01" pos=".02 0 0" mass=".02"/></body>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize("each", [1, 3])
def test_a_robot_without_contact_moves_as_alone(x64, each):
    """Also where its substep lasts several of the soft body's: its own forces do not add energy to a spring."""
    mesh = tetmesh.box((0.1, 0.1, 0.1), (1, 1, 1), tets_per_cell=5)
    robot = rigid.load(SPRING, dt=2e-3)
    scene = tets.make_scene(
        mesh=mesh, density=1000.0, mu=1e4, lam=2e4, dt=2e-3 / each, gravity=(0.0, 0.0, 0.0),
    )  # fmt: skip
    start = rigid.initial_state(robot, qpos=[0.01, 1.0, 0.0, 0.0, 0.0], qvel=[0.0, 2.0, 1.0, -3.0])
    alone = jax.jit(rigid.step, static_argnames="num_substeps")(robot, start, num_substeps=200)
    _, beside, _ = RUN(scene, robot, tets.initial_state(mesh.vertices + 5.0), start, num_substeps=200)
    np.testing.assert_allclose(beside.qvel, alone.qvel, atol=1e-8)
    np.testing.assert_allclose(beside.qpos[0], alone.qpos[0], atol=1e-10)


def test_substeps_whose_constraints_do_not_balance_are_remembered(monkeypatch):
    """Those of this step alone, wherever in it they are."""
    model = model_of()
    scene, state = dough_under(model)
    rates = articulated.rates

    def unbalanced(model, robot, *inputs):
        rate, after = rates(model, robot, *inputs)
        return rate, after.replace(unsolved=robot.unsolved + 1.0)

    monkeypatch.setattr(articulated, "rates", unbalanced)
    step = jax.jit(lambda robot: articulated.step(scene, model, state, robot, num_substeps=3)[1])
    assert float(step(thrown(model).replace(unsolved=jnp.float32(7.0))).unsolved) == 3.0


def test_lengths_that_do_not_fit_say_what_to_do():
    model = model_of(dt=5e-4)
    scene, state = dough_under(model, dt=4e-4)
    with pytest.raises(ValueError, match=r"^the scene's dt 0\.0004 s does not divide the model's 0\.0005 s: choose "):
        articulated.step(scene, model, state, thrown(model))


@pytest.mark.slow
def test_gradients_are_those_of_differences(x64):
    """By throw, motor, mass and stiffness; reverse equals forward; two particle substeps in one of the robot."""
    finger = FINGER.format(mass=0.03)
    text = FLOATING.format(finger=finger).replace(
        "</worldbody>", '</worldbody><actuator><motor joint="bend" gear=".02"/></actuator>'
    )
    model = rigid.load(text, dt=8e-4)
    scene, state = dough_under(model)
    state = state.replace(x=state.x + jnp.array([0.0, 0.012, 0.0]))

    def end(p):
        changed = model.replace(parameters={**model.parameters, "body_mass": model.parameters["body_mass"] * p["mass"]})
        material = replace_leaf(scene.material, "elasticity.youngs_modulus", 5e3 * p["stiffness"])
        robot = thrown(model)
        robot = robot.replace(qvel=robot.qvel + p["throw"])
        after, robot, wrench = articulated.step(
            scene.replace(material=material), changed, state, robot, p["ctrl"], num_substeps=10
        )
        return jnp.sum(jnp.sin(40 * after.x)) + jnp.sum(robot.qpos * jnp.arange(8.0)) + 0.1 * jnp.sum(wrench.torque)

    point = {"throw": jnp.zeros(7), "ctrl": jnp.array([0.5]), "mass": jnp.asarray(1.0), "stiffness": jnp.asarray(1.0)}
    f, slope = jax.jit(end), jax.jit(jax.grad(end))(point)
    forward = jax.jit(lambda p, d: jax.jvp(end, (p,), (d,))[1])
    for k in range(3):
        keys = jax.random.split(jax.random.key(k), 4)
        along = {n: jax.random.normal(key, a.shape) for key, (n, a) in zip(keys, point.items(), strict=True)}
        h = 1e-6
        ahead, behind = (f(jax.tree.map(lambda a, d, s=s: a + s * h * d, point, along)) for s in (1, -1))
        found = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(along), strict=True))
        np.testing.assert_allclose(forward(point, along), found, rtol=1e-9)
        np.testing.assert_allclose((ahead - behind) / (2 * h), found, rtol=1e-5)


def test_states_of_others_are_refused():
    model = model_of()
    scene, state = dough_under(model)
    robot = thrown(model)
    for given, sentence in (
        ((scene, model, robot, state), "state is a RigidState, but scene a MPMScene: give a MPMState"),
        ((scene, model, state, free_body.bodies_at_rest([[0.0, 0.0, 0.0]])), "state is .* give a state that rigid"),
        ((scene, "x", state, robot), "model is 'x': give a model that rigid.load returned"),
        ((model, scene, state, robot), "scene is .* give a scene of mpm.make_scene"),
        (
            (scene, model_of(FINGER.format(mass=0.1)), state, robot),
            r"the state's qpos has shape \(7,\): give shape \(8,\)",
        ),
    ):
        with pytest.raises(ValueError, match=sentence):
            articulated.step(*given)


def test_numbers_of_two_precisions_are_refused():
    model = model_of()
    scene, state = dough_under(model)
    with jax.enable_x64(True):
        robot = rigid.initial_state(model_of())
        with pytest.raises(ValueError, match="the state has numbers of float32, but the scene or the poses of float64"):
            articulated.step(scene, model, state, robot, num_substeps=1)
