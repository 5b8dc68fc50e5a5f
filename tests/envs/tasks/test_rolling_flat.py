"""RollingFlat: the paper's constants and formulas, the pin's kinematics, and gradients through the dough."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_numbers

import rewax
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.tasks.rolling_flat import RollingFlat, paper, small
from rewax.physics import mpm
from rewax.physics.mpm import Hencky, VonMises
from rewax.physics.mpm.walls import WallKind
from rewax.physics.shapes import Capsule
from rewax.status import Status
from rewax.struct import replace_leaf

PAPER, SMALL = paper(), small()


@pytest.fixture(scope="module")
def step():
    """One compiled control step at scale small."""
    return jax.jit(SMALL.step)


@pytest.fixture(scope="module")
def start():
    return jax.jit(SMALL.reset)(jax.random.key(0))


def press(step, state, action, num):
    """States after each of so many equal actions."""
    states = []
    for _ in range(num):
        state = step(state, jnp.asarray(action))
        states.append(state)
    return states


# --- What the environment is -----------------------------------------------------------------------------------------


def test_paper_has_the_papers_constants():
    env = rewax.make("RollingFlat", scale="paper")
    assert isinstance(env, RollingFlat)
    scene, material = env.scene, env.scene.material
    assert (env.num_substeps, env.max_steps, env.cloud.stride, env.cloud.num_points) == (40, 300, 10, 250)
    assert scene.dt == 5e-5 and env.control_dt == pytest.approx(2e-3)
    assert scene.grid.spacing == 1 / 48 and scene.grid.origin == (0.0, 0.0, 0.0)
    # The reference keeps particles between 0.5 and 47.5 cells, along all axes.
    np.testing.assert_allclose(scene.grid.lower, [0.5 / 48] * 3)
    np.testing.assert_allclose(scene.grid.upper, [47.5 / 48] * 3)
    np.testing.assert_array_equal(scene.gravity, [0.0, -90.0, 0.0])
    assert env.rest_positions.shape == (2592, 3)
    np.testing.assert_allclose(scene.particle_volume, 4.34e-6, rtol=1e-3)
    numbers = flat_numbers(material)
    found = [numbers[n] for n in ("youngs_modulus", "poissons_ratio", "density", "yield_stress")]
    np.testing.assert_allclose(found, [5000.0, 0.2, 1.0, 50.0])
    assert (type(material.elasticity), type(material.plasticity)) == (Hencky, VonMises)
    np.testing.assert_allclose(env.joint_start, [0.5, 0.2875, 0.0])
    np.testing.assert_allclose(env.joint_lower, [0.12, 0.1225, -0.66 * np.pi], rtol=1e-6)
    np.testing.assert_allclose(env.joint_upper, [0.88, 0.3725, 0.66 * np.pi], rtol=1e-6)
    np.testing.assert_allclose(env.joint_step, [0.01, 0.01, np.pi / 60], rtol=1e-6)
    walls = scene.walls
    assert [wall.kind for wall in walls.lower] == [WallKind.SEPARATING, WallKind.GRIPPING, WallKind.SEPARATING]
    assert [wall.kind for wall in walls.upper] == [WallKind.SEPARATING] * 3
    assert [wall.position for wall in walls.lower] == [3 / 48] * 3
    assert [wall.position for wall in walls.upper] == [1 - 3 / 48] * 3
    sizes = [(float(c.shape.radius), float(c.shape.half_length)) for c in scene.colliders]
    np.testing.assert_allclose(sizes, [(0.03, 0.2), (0.012, 0.3)], rtol=1e-6)
    for collider in scene.colliders:
        assert isinstance(collider.shape, Capsule)
        np.testing.assert_allclose([collider.friction, collider.softness], [0.9, 666.0], rtol=1e-6)
        np.testing.assert_array_equal(collider.offset, [0.0, 0.0, 0.5])


def test_paper_dough_fills_its_box_uniformly():
    unit = (np.asarray(PAPER.rest_positions) - [0.5, 0.15, 0.5]) / [0.3, 0.125, 0.3] + 0.5
    assert unit.min() >= -1e-6 and unit.max() <= 1 + 1e-6
    counts = np.histogramdd(np.clip(unit, 0, 1), bins=(3, 3, 3))[0]
    assert np.abs(counts / 96 - 1).max() < 0.4  # 96 in each of 27 parts; four standard deviations
    np.testing.assert_array_equal(PAPER.rest_positions, paper().rest_positions)  # the same in every environment


def test_small_dough_rests_on_the_floor_under_the_pin():
    x = np.asarray(SMALL.rest_positions)
    assert 0.0625 <= x[:, 1].min() < 0.07 and 0.18 < x[:, 1].max() <= 0.1875
    assert float(SMALL.scene.walls.lower[1].position) == float(SMALL.height_origin) == 0.0625
    np.testing.assert_allclose(SMALL.joint_start, [0.5, 0.1875 + 0.05, 0.0], rtol=1e-6)


@pytest.mark.parametrize(("env", "stride", "num"), [(PAPER, 10, 250), (SMALL, 4, 64)])
def test_observes_some_particles_their_mean_and_the_joint(env, stride, num):
    state = env.reset(jax.random.key(1))
    x = np.asarray(state.physics.soft.x)
    assert x.shape == env.rest_positions.shape
    seen = x[::stride][:num]
    assert seen.shape == (num, 3)
    np.testing.assert_array_equal(state.obs["particle_q"], seen)
    np.testing.assert_allclose(state.obs["com_q"], seen.mean(0), rtol=1e-5)
    np.testing.assert_array_equal(state.obs["joint_q"], env.joint_start)
    assert ("joint_qd" in state.obs) == (env is SMALL)


# --- Reset -----------------------------------------------------------------------------------------------------------


def noise(env, num=64):
    """Shifts and stretches of many resets, recovered from the positions; and the states."""
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num))
    rest, x = np.asarray(env.rest_positions), np.asarray(states.physics.soft.x)
    stretch = (x[:, 1, 0] - x[:, 0, 0]) / (rest[1, 0] - rest[0, 0])
    shift = x[:, 0] / stretch[:, None] - rest[0]
    np.testing.assert_allclose(x, (rest + shift[:, None]) * stretch[:, None, None], atol=1e-9)  # one rigid change
    return shift, stretch - 1.0, states


def is_in_steps(value, step):
    return np.abs(value / step - np.round(value / step)).max() < 1e-5


def test_paper_reset_draws_shift_and_stretch_in_thousandths_of_their_bounds(x64):
    shift, stretch, states = noise(paper())
    for value, low, high in [
        (shift[:, 0], -0.1, 0.1),
        (shift[:, 1], 0, 0.05),
        (shift[:, 2], -0.1, 0.1),
        (stretch, -0.1, 0.1),
    ]:
        assert value.min() >= low - 1e-9 and value.max() <= high + 1e-9
        assert np.ptp(value) > 0.8 * (high - low)
        assert is_in_steps(value, high / 1000) and not is_in_steps(value, high / 500)
    dough = states.physics.soft
    np.testing.assert_array_equal(dough.F, np.broadcast_to(np.eye(3), dough.F.shape))
    assert not np.any(dough.v) and not np.any(dough.C)
    np.testing.assert_allclose(states.physics.joint_q[:, 1], 0.2875)


def test_small_reset_shifts_along_x_only(x64):
    shift, stretch, _ = noise(small())
    np.testing.assert_allclose(shift[:, 1:], 0.0, atol=1e-9)
    np.testing.assert_allclose(stretch, 0.0, atol=1e-9)
    assert -0.1 - 1e-9 <= shift[:, 0].min() < -0.08 and 0.08 < shift[:, 0].max() <= 0.1 + 1e-9
    assert is_in_steps(shift[:, 0], 1e-4) and not is_in_steps(shift[:, 0], 2e-4)


def test_gradient_of_a_reset_by_its_noise_is_as_if_it_did_not_round(x64):
    """With the unit draws u: the shift is lower + u (upper - lower), u in [0, 1]; the stretch is u stretch."""
    env, key = paper(), jax.random.key(5)
    rest, scales = env.rest_positions[0], {n: getattr(env.noise, n) for n in ("shift_lower", "shift_upper", "stretch")}
    first = lambda scales: env.replace(noise=env.noise.replace(**scales)).reset(key).physics.soft.x[0]  # noqa: E731
    slope, x = jax.jit(lambda scales: (jax.jacobian(first)(scales), first(scales)))(scales)
    shift, stretch = (jnp.diag(slope["shift_lower"] + slope["shift_upper"]), slope["stretch"] * env.noise.stretch)
    np.testing.assert_allclose(shift, jnp.broadcast_to(shift[0], 3))  # 1 + stretch, whatever u
    np.testing.assert_allclose((rest + (x - rest * shift) / shift) * shift, x, rtol=1e-9)
    np.testing.assert_allclose(stretch / (x / shift), shift - 1.0, atol=1e-4)  # half a thousandth of 0.1


def test_resets_repeat_with_their_key():
    a, b, c = (SMALL.reset(jax.random.key(k)).obs["particle_q"] for k in (0, 0, 1))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


# --- Reward ----------------------------------------------------------------------------------------------------------


def expected_reward(y, scale, origin):
    d = (y.mean() - origin) / scale
    return (1 / (1 + d)) ** 2 * (2.0 if d <= 0.33 else 1.0) - y.var() * len(y) / (len(y) - 1), d


@pytest.mark.parametrize(("env", "origin"), [(PAPER, 0.0), (SMALL, 0.0625)])
@pytest.mark.parametrize("d", [0.2, 0.329, 0.331, 0.9])
def test_reward_is_the_papers_formula(env, origin, d):
    x = np.random.default_rng(0).normal(size=env.rest_positions.shape) * [1.0, 0.05, 1.0]
    seen = x[:: env.cloud.stride][: env.cloud.num_points, 1]
    x[:, 1] += origin + 0.125 * d - seen.mean()
    zeros = jnp.zeros(3)
    physics = SoftPhysics(soft=mpm.initial_state(jnp.asarray(x)), joint_q=zeros, joint_qd=zeros, action=zeros)
    reward, metrics = env.reward(physics)
    seen = x[:: env.cloud.stride][: env.cloud.num_points, 1]
    expected, flatness = expected_reward(seen, 0.125, origin)
    assert flatness == pytest.approx(d)
    np.testing.assert_allclose(reward, expected, rtol=2e-5)
    np.testing.assert_allclose(metrics["flatness"], d, rtol=2e-5)
    np.testing.assert_allclose(metrics["height_variance"], seen.var(ddof=1), rtol=1e-4)


def test_step_rewards_what_it_shows(step, start):
    for state in press(step, start, [0.3, -1.0, 0.2], 3):
        y = np.asarray(state.obs["particle_q"])[:, 1]
        np.testing.assert_allclose(state.reward, expected_reward(y, 0.125, 0.0625)[0], rtol=1e-5)
        np.testing.assert_array_equal(state.obs["particle_q"], state.physics.soft.x[::4][:64])
        assert int(state.status) == Status.OK and not bool(state.done)


# --- Pin -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("action", [(1.0, -1.0, 1.0), (-0.5, 0.25, -0.1), (3.0, 0.0, -7.0)])
def test_pin_moves_by_the_action_times_its_step(step, start, action):
    clipped = np.clip(action, -1, 1)
    for i, state in enumerate(press(step, start, action, 2), start=1):
        q = np.asarray(SMALL.joint_start) + i * np.asarray(SMALL.joint_step) * clipped
        np.testing.assert_allclose(state.obs["joint_q"], q, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(state.obs["joint_qd"], clipped, rtol=1e-5)
        np.testing.assert_array_equal(state.physics.joint_q, state.obs["joint_q"])


@pytest.mark.parametrize(("side", "sign"), [("joint_lower", -1.0), ("joint_upper", 1.0)])
def test_pin_stops_at_its_limits(step, start, side, sign):
    limit, size = getattr(SMALL, side), SMALL.joint_step
    state = start.replace(physics=start.physics.replace(joint_q=limit - sign * 0.25 * size))
    one, two, back = press(step, state, [sign] * 3, 2) + press(step, state, [-sign] * 3, 1)
    np.testing.assert_allclose(one.obs["joint_q"], limit, rtol=1e-6)
    np.testing.assert_allclose(one.obs["joint_qd"], [0.25 * sign] * 3, rtol=1e-4)
    np.testing.assert_allclose(two.obs["joint_q"], limit, rtol=1e-6)
    np.testing.assert_allclose(two.obs["joint_qd"], np.zeros(3), atol=1e-4)
    np.testing.assert_allclose(back.obs["joint_q"], limit - sign * 1.25 * size, rtol=1e-6)


def test_a_limit_passes_no_gradient_to_what_pushes_against_it(start):
    state = start.replace(physics=start.physics.replace(joint_q=SMALL.joint_lower.at[0].set(0.5)))
    slope = jax.jit(jax.jacobian(lambda a: SMALL.step(state, a).physics.joint_q))(jnp.array([0.5, -0.5, 0.5]))
    np.testing.assert_allclose(slope, np.diag(np.asarray(SMALL.joint_step) * [1.0, 0.0, 1.0]), rtol=1e-6)


@pytest.mark.parametrize(("exact", "slopes"), [(True, [0.0, 1.0, 1.0]), (False, [1.0, 1.0, 1.0])])
def test_a_limit_hides_where_the_pin_came_from_unless_it_is_frozen(start, exact, slopes):
    """The pin is stopped along x. The reference's limits are frozen."""
    env, q, action = SMALL.replace(exact_limits=exact), SMALL.joint_lower.at[2].set(0.3), jnp.array([-0.5, 0.5, -0.5])

    def after(q):
        return env.step(start.replace(physics=start.physics.replace(joint_q=q)), action).physics.joint_q

    np.testing.assert_allclose(jax.jit(jax.jacobian(after))(q), np.diag(slopes), atol=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -1.2])
def test_yaw_swings_the_papers_pin_and_turns_the_small_one(yaw):
    for env, centre in (
        (PAPER, [0.4 + 0.5 * np.sin(yaw), 0.2, 0.5 * np.cos(yaw)]),  # about z = 0, where the reference has its joint
        (SMALL, [0.4, 0.2, 0.5]),
    ):
        physics = env.reset(jax.random.key(0)).physics.replace(joint_q=jnp.array([0.4, 0.2, yaw]))
        shapes = env.render_shapes(physics)
        assert [s["kind"] for s in shapes] == ["capsule"] * len(env.scene.colliders)
        for shape in shapes:
            np.testing.assert_allclose(shape["center"], centre, atol=1e-6)
            np.testing.assert_allclose(shape["direction"], [np.sin(yaw), 0.0, np.cos(yaw)], atol=1e-6)


def test_pressing_lowers_the_dough(step, start):
    pressed, left = (np.array([s.obs["com_q"][1] for s in press(step, start, a, 8)]) for a in ([0.0, -1, 0], [0.0] * 3))
    assert abs(left[-1] - start.obs["com_q"][1]) < 0.01  # it settles a little under gravity
    assert pressed[-1] < left[-1] - 0.002 and (pressed < left).all()


def test_episode_ends_at_the_time_limit(step, start):
    state = step(start.replace(step_count=jnp.int32(58)), jnp.zeros(3))
    assert not bool(state.done)
    state = step(state, jnp.zeros(3))
    assert bool(state.truncated) and not bool(state.terminated)


# --- Gradients -------------------------------------------------------------------------------------------------------


def reduced():
    """Two substeps per control step and 64 particles, all observed, on the small grid; the pin presses 2 mm a step."""
    env = small()
    step, start = env.joint_step * jnp.array([0.1, 0.5, 0.1]), env.joint_start - jnp.array([0.0, 0.02, 0.0])
    env = env.replace(joint_step=step, joint_start=start)
    return env.replace(rest_positions=env.rest_positions[:64], num_substeps=2, cloud=PointCloud(num_points=64))


@pytest.fixture(scope="module")
def reduced_gradient():
    """Of a reduced environment from four first states: actions and moduli, the returns of eight steps as a function of
    them, and their gradients."""
    with jax.enable_x64(True):
        env, keys = reduced(), jax.random.split(jax.random.key(7), 4)
        actions = jax.random.uniform(jax.random.key(8), (4, 8, 3), minval=-0.9, maxval=0.9)

        def total(x, key):
            changed = replace_leaf(env, "scene.material.elasticity.youngs_modulus", x["modulus"])
            step = lambda s, a: ((new := changed.step(s, a)), new.reward)  # noqa: E731
            return jax.lax.scan(step, env.reset(key), x["actions"])[1].sum()

        x = {"actions": actions.at[..., 1].set(-jnp.abs(actions[..., 1])), "modulus": jnp.full(4, 750.0)}
        both = jax.jit(jax.vmap(jax.value_and_grad(total)))
        return x, lambda x: both(x, keys)[0], both(x, keys)[1]


def central(f, x, dx, h):
    ahead, behind = (f(jax.tree.map(lambda a, d: a + s * h * d, x, dx)) for s in (1, -1))
    return np.asarray(ahead - behind) / (2 * h)


@pytest.mark.parametrize("component", range(3))
def test_gradient_by_the_action_is_that_of_finite_differences(x64, reduced_gradient, component):
    x, f, slope = reduced_gradient
    for t in (0, 2, 6):
        dx = {"actions": np.zeros((4, 8, 3)), "modulus": np.zeros(4)}
        dx["actions"][:, t, component] = 1.0
        got, scale = slope["actions"][:, t, component], float(jnp.abs(slope["actions"]).max())
        np.testing.assert_allclose(got, central(f, x, dx, 1e-5), rtol=1e-3, atol=1e-3 * scale)
    assert np.abs(slope["actions"][..., component]).max() > 1e-8


def test_gradient_by_the_modulus_is_that_of_finite_differences(x64, reduced_gradient):
    x, f, slope = reduced_gradient
    expected = central(f, x, {"actions": jnp.zeros((4, 8, 3)), "modulus": jnp.ones(4)}, 1e-3)
    assert (expected != 0.0).all()
    np.testing.assert_allclose(slope["modulus"], expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_gradient_of_the_return_is_finite_and_rewards_pressing(reduced_gradient):
    slope = np.asarray(reduced_gradient[2]["actions"])
    assert np.isfinite(slope).all()
    assert (slope[:, :, 1].sum(axis=1) < 0).all()  # lower is better
    assert (np.abs(slope[:, 0]) > 0).any(axis=1).all()  # the first action matters still


# --- Mistakes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "sentence"),
    [
        (
            {"dt": 1e-2, "num_substeps": 1},
            "dt is 0.01 s, above the largest stable .* s for this material on a grid of spacing .* m: take ",
        ),
        ({"youngs_modulus": 1e6}, "dt is 0.0007 s, above the largest stable .*: take more substeps"),
        (
            {"youngs_modulus": -1.0},
            r"youngs_modulus is -1\.0, but must be positive: give a number of pascals",
        ),
        ({"yield_stress": 0.0}, r"yield_stress is 0\.0, but must be positive: give a number of pascals"),
        ({"dt": 0.0}, "dt is 0.0, but must be positive: give the duration of a substep in seconds"),
    ],
)
def test_impossible_arguments_say_what_to_do(kwargs, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}") as error:
        rewax.make("RollingFlat", scale="small", **kwargs)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("action", [0.5, jnp.zeros((1, 3)), jnp.zeros(4), np.zeros(1)])
@pytest.mark.parametrize("env", [PAPER, SMALL])
def test_an_action_of_another_shape_is_refused(start, env, action):
    shape = re.escape(str(np.shape(action)))
    with pytest.raises(ValueError, match=rf"^the action has shape {shape}: give shape \(3,\), and jax\.vmap over step"):
        env.step(start, action)


@pytest.mark.parametrize(
    ("key", "sentence"),
    [
        (0, r"the key is 0: give a random key, jax\.random\.key\(0\) for example$"),
        (None, "the key is None: give a random key"),
        (jnp.zeros(2), r"the key is an array of float32 of shape \(2,\): give a random key"),
        (
            jax.random.split(jax.random.key(0), 4),
            r"the key holds keys of shape \(4,\): give one key, and jax\.vmap over ",
        ),
    ],
)
def test_a_reset_without_a_key_says_what_to_give(key, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        SMALL.reset(key)


# --- The pin drags the dough -----------------------------------------------------------------------------------------


def test_the_pin_drags_the_dough_it_presses_on(step, start):
    """Along its motion, to either side alike; the more the nearer to it; and not at all where it does not touch."""
    down = press(step, start, [0.0, -1.0, 0.0], 6)[-1]
    rest = np.asarray(start.physics.soft.x)
    top, bottom = rest[:, 1] > 0.14, rest[:, 1] < 0.10

    def moved(state, direction):
        after, still = (press(step, state, [d, 0.0, 0.0], 3)[-1].physics.soft.x for d in (direction, 0.0))
        return np.asarray(after - still)[:, 0]

    right, left = moved(down, 0.5), moved(down, -0.5)
    assert right[top].mean() > 0.002 and left[top].mean() < -0.002  # the pin itself moves by 30 mm
    assert right[top].mean() > 1.5 * right[bottom].mean() > 0.0
    assert left[top].mean() < 1.5 * left[bottom].mean() < 0.0
    lifted = press(step, start, [0.0, 1.0, 0.0], 6)[-1]
    assert np.abs(moved(lifted, 0.5)).max() < 1e-4
