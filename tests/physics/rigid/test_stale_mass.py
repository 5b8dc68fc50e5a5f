"""Substeps that share one mass matrix: Warp's equations in numpy, a torque that no force makes, gradients, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rigid_models
from scipy.spatial.transform import Rotation

import rewax
from rewax.physics import rigid
from rewax.physics.rigid.stale_mass import step_with_stale_mass

DT, NUM_SUBSTEPS = 1e-3, 16
PENALTY = rigid.Penalty(stiffness=1e4, damping=100.0, friction_damping=100.0)
BRICK = """<mujoco><option gravity="0 0 -9.81"/><worldbody><body><freejoint/>
  <geom type="box" size=".1 .2 .3" mass="4" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
HALF_SIZE, MASS, GRAVITY = np.array([0.1, 0.2, 0.3]), 4.0, np.array([0.0, 0.0, -9.81])


def skew(a):
    return np.cross(np.eye(3), a)


def spatial_inertia(center, rotation):
    """Of the brick about the world's origin, for twists [angular, linear], shape (6, 6)."""
    square = HALF_SIZE**2
    inertia = rotation @ np.diag(MASS / 3 * (square.sum() - square)) @ rotation.T
    arm = skew(center)
    top = np.concatenate([inertia - MASS * arm @ arm, MASS * arm], axis=1)
    return np.concatenate([top, np.concatenate([-MASS * arm, MASS * np.eye(3)], axis=1)])


def warps_flight(place, rotation, velocity, spin, *, renewed):
    """The brick's place, velocity and spin after a control step, by its twist about the world's origin."""
    twist = np.concatenate([spin, velocity - np.cross(spin, place)])
    kept = spatial_inertia(place, rotation)
    for _ in range(NUM_SUBSTEPS):
        inertia = spatial_inertia(place, rotation)
        momentum, (spin, linear) = inertia @ twist, (twist[:3], twist[3:])
        gyroscopic = [np.cross(spin, momentum[:3]) + np.cross(linear, momentum[3:]), np.cross(spin, momentum[3:])]
        weight = [np.cross(place, MASS * GRAVITY), MASS * GRAVITY]
        force = np.concatenate(weight) - np.concatenate(gyroscopic)
        twist = twist + DT * np.linalg.solve(inertia if renewed else kept, force)
        place = place + DT * (twist[3:] + np.cross(twist[:3], place))
        rotation = Rotation.from_rotvec(DT * twist[:3]).as_matrix() @ rotation
    return place, twist[3:] + np.cross(twist[:3], place), twist[:3]


def brick():
    return rigid.load(BRICK, dt=DT, penalty=PENALTY)


def flown(model, place, turn, velocity, spin, step=step_with_stale_mass):
    """The same by rewax; the spin in world axes."""
    qpos = np.concatenate([place, turn.as_quat()[[3, 0, 1, 2]]])
    qvel = np.concatenate([velocity, turn.inv().apply(spin)])
    end = step(model, rigid.initial_state(model, qpos, qvel), num_substeps=NUM_SUBSTEPS)
    return end.qpos[:3], end.qvel[:3], Rotation.from_quat(np.roll(end.qpos[3:7], -1)).apply(np.array(end.qvel[3:]))


def test_a_brick_flies_as_in_warps_equations_far_from_the_origin(x64):
    place, velocity, spin = np.array([7.0, -20.0, 3.0]), np.array([3.0, 5.0, -2.0]), np.array([4.0, -2.0, 6.0])
    turn = Rotation.from_rotvec([0.4, -1.0, 0.3])
    expected = warps_flight(place, turn.as_matrix(), velocity, spin, renewed=False)
    for ours, theirs in zip(flown(brick(), place, turn, velocity, spin), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-11)
    exact = warps_flight(place, turn.as_matrix(), velocity, spin, renewed=True)
    assert np.abs(exact[2] - expected[2]).max() > 1e-3


def test_weight_turns_a_body_that_moves_on(x64):
    """The torque v t x m g, where a renewed mass matrix leaves the body without spin."""
    place, still, velocity = np.zeros(3), np.zeros(3), np.array([0.5, 0.0, 0.0])
    args = (brick(), place, Rotation.identity(), velocity, still)
    np.testing.assert_allclose(flown(*args, step=rigid.step)[2], 0.0, atol=1e-12)
    moment = MASS / 3 * (HALF_SIZE[0] ** 2 + HALF_SIZE[2] ** 2)
    travelled = DT * velocity[0] * np.arange(NUM_SUBSTEPS)
    expected = np.sum(DT * travelled * MASS * 9.81) / moment  # about y: x cross -z
    np.testing.assert_allclose(flown(*args)[2], [0.0, expected, 0.0], atol=0.01 * expected)


@pytest.fixture(scope="module")
def ant():
    """A control step of AntRun from a running start that touches the ground, in double precision."""
    with jax.enable_x64(True):
        env = rewax.make("AntRun", scale="small", stale_mass_matrix=True)
        qpos = jnp.array([5.0, 0.4, 1.0, np.sqrt(0.5), -np.sqrt(0.5), 0.1, 0.0, 0.1, 1.2, 0.0, -1, 0, -1.1, -0.1, 0.9])
        qvel = jnp.linspace(-1.0, 2.0, 14).at[0].set(6.0)
        return env.model, rigid.initial_state(env.model, qpos, qvel), jnp.linspace(-0.5, 0.5, 8)


def test_one_substep_differs_from_a_renewed_one_by_the_square_of_its_length(ant, x64):
    """Where the twist is kept, the velocity of a point of the body is not: by omega x v dt, less with a shorter dt."""
    model, state, ctrl = ant

    def difference(dt):
        shorter = model.replace(static=rigid.load(model.static.mj, dt=dt, penalty=model.penalty).static)
        ends = [step(shorter, state, ctrl) for step in (step_with_stale_mass, rigid.step)]
        return np.abs(ends[0].qvel - ends[1].qvel).max()

    coarse, fine = difference(2e-5), difference(1e-5)
    assert fine > 1e-9 and coarse / fine == pytest.approx(4.0, rel=0.05)


def test_gradients(ant, x64):
    """Reverse, forward and central differences, by start, controls and a mass."""
    model, state, ctrl = ant

    @jax.jit
    def value(numbers):
        qpos, qvel, ctrl, mass = numbers
        changed = model.with_parameters(body_mass=mass)
        end = step_with_stale_mass(changed, state.replace(qpos=qpos, qvel=qvel), ctrl, num_substeps=4)
        return jnp.sum(jnp.sin(3.0 * end.qpos)) + jnp.sum(jnp.cos(end.qvel))

    numbers = (state.qpos, state.qvel, ctrl, model.parameters["body_mass"])
    rng = np.random.default_rng(0)
    along = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), numbers)
    reverse = jax.jit(jax.grad(value))(numbers)
    slope = sum(jnp.vdot(r, a) for r, a in zip(reverse, along, strict=True))
    forward = jax.jvp(value, (numbers,), (along,))[1]
    shifted = [value(jax.tree.map(lambda n, a, h=h: n + h * a, numbers, along)) for h in (1e-6, -1e-6)]
    np.testing.assert_allclose(forward, slope, rtol=1e-10)
    np.testing.assert_allclose((shifted[0] - shifted[1]) / 2e-6, slope, rtol=1e-6)
    assert all(np.abs(r).max() > 1e-3 for r in reverse)


def test_an_episode_of_the_option_differs_and_stays_finite():
    plain, stale = (rewax.make("AntRun", scale="small", stale_mass_matrix=option) for option in (False, True))
    state = jax.jit(plain.reset)(jax.random.key(0))
    push = jnp.full(8, 0.3)
    ends = [jax.jit(env.step)(state, push).physics.rigid.qvel for env in (plain, stale)]
    assert np.isfinite(ends[1]).all() and np.abs(ends[0] - ends[1]).max() > 1e-5
    np.testing.assert_allclose(ends[0], ends[1], atol=0.2)


def test_other_models_are_refused():
    for text, penalty in ((rigid_models.pendulum(1), PENALTY), (BRICK, None)):
        model = rigid.load(text, penalty=penalty)
        with pytest.raises(ValueError, match="a mass matrix is kept for models with a penalty law"):
            step_with_stale_mass(model, rigid.initial_state(model))
