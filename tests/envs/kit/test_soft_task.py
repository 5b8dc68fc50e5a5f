"""What soft tasks share: joints and their limits, point clouds, status, mistakes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks

import rewax
from rewax import struct
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_task import SoftTask
from rewax.envs.kit.start_noise import reset_noise
from rewax.physics import tets
from rewax.physics.contact import Collider, PenaltyContact
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Sphere
from rewax.testing import check_env


@struct.dataclass
class Poke(SoftTask):
    """Push a tet along x with a ball; its one joint is the ball's place."""

    def poses(self, joint_q):
        position = joint_q * jnp.array([1.0, 0.0, 0.0])
        return Pose(position[:, None], jnp.broadcast_to(jnp.eye(3), (len(joint_q), 1, 3, 3)))

    def reward(self, physics):
        reach = physics.soft.x[:, 0].mean()
        return reach, {"reach": reach}


def poke(**changes):
    mesh = tets.TetMesh(vertices=np.eye(4)[:, :3], tets=np.array([[3, 0, 1, 2]]))
    scene = tets.make_scene(
        mesh=mesh, density=1.0, mu=100.0, lam=100.0, dt=1e-3, gravity=(0.0, 0.0, 0.0),
        contact=PenaltyContact(stiffness=50.0), colliders=(Collider(shape=Sphere(radius=0.3), friction=0.0),),
    )  # fmt: skip
    options = {
        "scene": scene,
        "rest_positions": jnp.asarray(mesh.vertices, jnp.float32),
        "joint_start": jnp.array([-0.25]),
        "joint_lower": jnp.array([-0.6]),
        "joint_upper": jnp.array([0.6]),
        "joint_step": jnp.array([0.05]),
        "noise": reset_noise((-0.01, 0.0, 0.0), (0.01, 0.0, 0.0)),
        "cloud": PointCloud(num_points=4),
        "num_substeps": 5,
        "max_steps": 12,
        **changes,
    }
    return Poke(**options)


def test_a_tool_moves_linearly_and_pushes_what_it_meets():
    env = poke()
    state = jax.jit(env.reset)(jax.random.key(0))
    assert state.obs.keys() == {"particle_q", "com_q", "joint_q"}
    step = jax.jit(env.step)
    statuses = []
    for i in range(8):
        state = step(state, jnp.array([2.0]))
        np.testing.assert_allclose(state.physics.joint_q, [-0.25 + 0.05 * (i + 1)], atol=1e-6)
        statuses.append(int(state.status))
    assert float(state.metrics["reach"]) > 0.27
    # The tet weighs little and its contact is soft: the ball's center enters it in the seventh step.
    assert statuses == [rewax.Status.OK] * 6 + [rewax.Status.PENETRATION] * 2


@pytest.mark.slow
def test_a_task_with_tets_passes_check_env():
    check_env(poke())


@pytest.mark.parametrize(("exact", "slope"), [(False, 1.0), (True, 0.0)])
def test_limits_are_frozen_or_exact(exact, slope):
    """Where a limit stops a joint, its place after the step has a derivative of 1 by its place before, or of 0."""
    env = poke(exact_limits=exact)
    state = jax.jit(env.reset)(jax.random.key(0))

    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1))
    def slopes(q, action):
        return env.step(state.replace(physics=state.physics.replace(joint_q=q)), action).physics.joint_q[0]

    by_place, by_action = slopes(jnp.array([0.58]), jnp.array([1.0]))
    np.testing.assert_allclose(by_place, [slope], atol=1e-6)
    np.testing.assert_allclose(by_action, [0.0], atol=1e-6)
    by_place, by_action = slopes(jnp.array([0.0]), jnp.array([0.5]))
    np.testing.assert_allclose([by_place[0], by_action[0]], [1.0, 0.05], rtol=1e-5)


def test_a_joint_that_stands_at_its_limit_can_leave_it():
    """Actions of zero there have the derivative of actions that move the joint away, in each step."""
    env = poke()
    state = jax.jit(env.reset)(jax.random.key(0))
    state = state.replace(physics=state.physics.replace(joint_q=env.joint_upper))

    def last(actions):
        return jax.lax.scan(lambda s, a: (env.step(s, a), None), state, actions)[0].physics.joint_q[0]

    np.testing.assert_allclose(jax.jit(jax.grad(last))(jnp.zeros((4, 1))), 0.05 * np.ones((4, 1)), rtol=1e-4)


@pytest.mark.parametrize("name", ["RollingFlat", "HandFlip", "FluidMove", "HandLift"])
def test_limits_are_exact_but_for_the_references_tasks(name):
    assert rewax.make(name, scale="small").exact_limits
    assert not rewax.make(name, scale="paper").exact_limits


# --- Point clouds ----------------------------------------------------------------------------------------------------


def see(cloud, key):
    x = jnp.arange(30.0).reshape(10, 3)
    return np.asarray(cloud.see(x, 100.0 + x, key)), np.asarray(x)


def test_a_cloud_shows_every_so_many_points():
    seen, x = see(PointCloud(num_points=3, stride=2), None)
    np.testing.assert_array_equal(seen, x[[0, 2, 4]])


def test_a_random_cloud_shows_other_points_at_every_step_none_twice():
    for wrong in ({"random": "no"}, {"velocities": 1}, {"noise": -1.0}, {"noise": (1.0, 2.0)}):
        with pytest.raises(ValueError, match=rf"PointCloud\.{next(iter(wrong))} (is|has) .*: give "):
            PointCloud(num_points=6, **wrong)
    cloud = PointCloud(num_points=6, random=True)
    first, x = see(cloud, jax.random.key(0))
    second, _ = see(cloud, jax.random.key(1))
    rows = [{int(r[0]) // 3 for r in seen} for seen in (first, second)]
    assert [len(r) for r in rows] == [6, 6] and rows[0] != rows[1]
    assert all((row == x).all(axis=1).any() for row in first)


def test_a_cloud_with_velocities_has_six_numbers_a_point():
    seen, x = see(PointCloud(num_points=4, velocities=True), None)
    np.testing.assert_array_equal(seen, np.concatenate([x, 100.0 + x], axis=1)[:4])


def test_noise_falls_on_positions_alone_with_its_deviation():
    cloud = PointCloud(num_points=10, velocities=True, noise=jnp.asarray(0.5))
    seen, x = zip(*(see(cloud, jax.random.key(k)) for k in range(200)), strict=True)
    error = np.asarray(seen)[..., :3] - np.asarray(x)
    assert abs(error.mean()) < 0.03 and error.std() == pytest.approx(0.5, rel=0.05)
    np.testing.assert_array_equal(np.asarray(seen)[..., 3:], 100.0 + np.asarray(x))


def test_a_noisy_cloud_changes_what_is_seen_and_nothing_else():
    plain, noisy = poke(), poke(cloud=PointCloud(num_points=3, random=True, velocities=True, noise=jnp.asarray(0.01)))
    assert noisy.observation_spec["particle_q"].shape == (3, 6)
    a, b = (jax.jit(env.step)(jax.jit(env.reset)(jax.random.key(2)), jnp.ones(1)) for env in (plain, noisy))
    np.testing.assert_array_equal(a.physics.soft.x, b.physics.soft.x)
    assert float(a.reward) == float(b.reward)
    np.testing.assert_array_equal(a.obs["com_q"], a.physics.soft.x.mean(0))
    np.testing.assert_allclose(b.obs["com_q"], b.obs["particle_q"][:, :3].mean(0), atol=1e-7)
    assert np.abs(b.obs["com_q"] - a.obs["com_q"]).max() > 1e-3  # the exact mean is hidden


@pytest.mark.slow
def test_a_task_with_a_noisy_cloud_passes_the_check():
    cloud = PointCloud(num_points=3, random=True, velocities=True, noise=jnp.asarray(0.01))
    check_env(poke(cloud=cloud), check_full_episode=False)


# --- Mistakes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"num_substeps": 0},
            "num_substeps is 0, but must be an integer of at least 1: give the number of substeps in a control step",
        ),
        (
            {"max_steps": 2.5},
            r"max_steps is 2\.5, but must be an integer of at least 1: give the number of control steps in an episode",
        ),
        (
            {"joint_step": (0.1, 0.1)},
            r"joint_step has shape \(2,\), but joint_start \(1,\): give one number for each joint",
        ),
        (
            {"joint_lower": jnp.array([0.7])},
            r"joint_lower is \[0.7\] and joint_upper \[0.6\]: give a lower limit below the upper one",
        ),
        ({"joint_step": jnp.array([-0.1])}, r"joint_step is \[-0.1\]: give the change per control step .*"),
        (
            {"joint_step": ("a",)},
            r"joint_step is \('a',\), which is no array of real numbers: give one number for each.*",
        ),
        (
            {"joint_start": 0.1},
            "joint_start is one number: give one number for each joint, a tuple of one for one joint",
        ),
        (
            {"joint_start": jnp.array([0.7])},
            r"joint_start is \[0.7\], outside of the limits \[-0.6\] to \[0.6\], to which the first step would make .*"
            "jump: give a start within the limits",
        ),
        ({"joint_start": jnp.array([-0.7])}, r"joint_start is \[-0.7\], outside of the limits .*"),
        ({"exact_limits": "no"}, "exact_limits is 'no': give True or False"),
        ({"scene": None}, "scene is None: give one of the class MPMScene or TetScene or ThinScene"),
        ({"cloud": "64"}, r"cloud is '64': give PointCloud\(num_points=...\)"),
        ({"noise": 0.1}, r"noise is .*: give reset_noise\(lower, upper\), or leave it out for none"),
        (
            {"rest_positions": "clay"},
            "rest_positions is 'clay', which is no array of real numbers: give positions in .*",
        ),
        (
            {"rest_positions": jnp.zeros((4, 2))},
            r"rest_positions has shape \(4, 2\): give positions in metres, shape .*",
        ),
        ({"touch": {"a": 3}}, r"touch is \{'a': 3\}: give None, and wrap the task in Sensing with a Touch"),
        ({"list_every": 5}, "list_every is 5, but tetrahedra have no list of active nodes: leave it out"),
        ({"list_every": 3}, "list_every is 3, which does not divide num_substeps = 5: choose a divisor, or None"),
    ],
)
def test_impossible_numbers_say_what_to_do(changes, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        poke(**changes)


def test_a_joint_may_start_one_step_beyond_its_limit_and_traced_joints_anywhere():
    env = poke(joint_start=jnp.array([0.65]))
    assert float(jax.jit(env.step)(env.reset(jax.random.key(0)), jnp.zeros(1)).obs["joint_q"][0]) == pytest.approx(0.6)
    assert jax.jit(lambda start: poke(joint_start=start).joint_start)(jnp.array([9.0])) == 9.0


def test_a_task_returns_what_its_methods_promise():
    class Wrong(Poke):
        def start(self, positions, key):
            return positions, None

    with pytest.raises(
        ValueError, match=r"^Wrong.start returned an array of .* for the soft bodies, which must be a Tet"
    ):
        struct.dataclass(Wrong)(**vars(poke())).reset(jax.random.key(0))


def test_a_joint_may_stand_still():
    env = poke(joint_step=jnp.zeros(1))
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), jnp.ones(1))
    assert float(state.obs["joint_q"][0]) == -0.25 and float(state.physics.joint_qd[0]) == 0.0
    assert int(state.status) == 0


@pytest.mark.parametrize(
    ("lower", "upper", "stretch"), [((0.01, 0, 0), (-0.01, 0, 0), 0.0), ((0, 0, 0),) * 2 + (-0.1,)]
)
def test_impossible_noise_says_what_to_do(lower, upper, stretch):
    with pytest.raises(ValueError, match="give a lower end below the upper one, and a stretch of 0 or more"):
        reset_noise(lower, upper, stretch)


@pytest.mark.parametrize("name", ["num_points", "stride"])
def test_an_impossible_cloud_says_what_to_do(name):
    with pytest.raises(ValueError, match=f"^PointCloud.{name} is 0, but must be an integer of at least 1: give"):
        PointCloud(**{"num_points": 3, name: 0})


def test_a_task_without_its_parts_says_what_to_define():
    task = SoftTask(
        **{name: getattr(poke(), name) for name in ("scene", "rest_positions", "cloud", "num_substeps", "max_steps")}
    )
    with pytest.raises(NotImplementedError, match=r"^SoftTask has no reward\(physics\): define it$"):
        task.reset(jax.random.key(0))
    with pytest.raises(NotImplementedError, match=r"^SoftTask has colliders but no poses\(joint_q\): define it$"):
        task.poses(jnp.zeros((3, 0)))


@pytest.mark.parametrize("name", ["HandFlip", "FluidMove", "SoftJumper"])
def test_episodes_truncate_at_the_time_limit_and_never_terminate(name):
    env, first = soft_tasks.make(name), soft_tasks.start(name)
    state = soft_tasks.run(name, first.replace(step_count=jnp.int32(env.max_steps - 2)), 0.0, 2)
    assert [bool(s.truncated) for s in state] == [False, True]
    assert not any(bool(s.terminated) for s in state)
