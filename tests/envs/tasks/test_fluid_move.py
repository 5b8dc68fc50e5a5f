"""FluidMove: the reference's numbers, what is spilt, the reward, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from flat_materials import flat_numbers
from soft_tasks import difference_errors, make

from rewax.envs.tasks import fluid_move
from rewax.physics.mpm import QuadraticFluid
from rewax.physics.mpm.walls import WallKind
from rewax.status import Status

PAPER, SMALL = make("FluidMove", "paper"), make("FluidMove")


def test_paper_has_the_references_constants():
    scene, material = PAPER.scene, PAPER.scene.material
    assert (PAPER.num_substeps, PAPER.max_steps, PAPER.cloud.num_points, PAPER.cloud.stride) == (40, 300, 250, 11)
    assert scene.dt == 5e-4 and scene.grid.spacing == 1 / 48 and PAPER.control_dt == pytest.approx(0.02)
    np.testing.assert_allclose(scene.gravity, [0.0, -9.8, 0.0], rtol=1e-6)
    assert PAPER.rest_positions.shape == (2880, 3)
    np.testing.assert_allclose(scene.particle_volume, 0.16 * 0.094 * 0.2 / 2880, rtol=1e-5)
    numbers = flat_numbers(material)
    found = [numbers[n] for n in ("youngs_modulus", "poissons_ratio", "density")]
    np.testing.assert_allclose(found, [1e5, 0.3, 1000.0], rtol=1e-6)
    assert isinstance(material.elasticity, QuadraticFluid)
    x = np.asarray(PAPER.rest_positions)
    np.testing.assert_allclose([x.min(0), x.max(0)], [[0.42, 0.103, 0.4], [0.58, 0.197, 0.6]], atol=2e-3)
    assert scene.walls.lower[1].kind is WallKind.SEPARATING and scene.walls.lower[1].friction is None
    np.testing.assert_allclose(PAPER.joint_start, [0.5, 0.15, 0.5])
    np.testing.assert_allclose(PAPER.joint_lower, [0.18, 0.16, 0.22], rtol=1e-6)
    np.testing.assert_allclose(PAPER.joint_upper, [0.82, 0.84, 0.78], rtol=1e-6)
    np.testing.assert_allclose(PAPER.joint_step, 0.01, rtol=1e-6)
    np.testing.assert_allclose(PAPER.outer, [0.14, 0.105, 0.16], rtol=1e-6)
    assert float(PAPER.spill_width) == pytest.approx(1e-5) and float(PAPER.distance_scale) == 1.0
    sizes = [np.asarray(c.shape.half_size) for c in scene.colliders]
    np.testing.assert_allclose(sizes[0], [0.14, 0.025, 0.16], rtol=1e-6)
    np.testing.assert_allclose(sizes[1], [0.025, 0.105, 0.16], rtol=1e-6)
    np.testing.assert_allclose(sizes[3], [0.14, 0.105, 0.025], rtol=1e-6)
    np.testing.assert_allclose(scene.colliders[0].offset, [0.0, -0.105, 0.0], rtol=1e-6)
    np.testing.assert_allclose(scene.colliders[2].offset, [0.115, -0.025, 0.0], rtol=1e-6)
    np.testing.assert_allclose(scene.colliders[3].offset, [0.0, -0.025, -0.135], rtol=1e-6)


@pytest.mark.parametrize("env", [PAPER, SMALL])
def test_only_the_target_is_drawn(env):
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 512))
    np.testing.assert_array_equal(
        states.physics.soft.x, np.broadcast_to(env.rest_positions, states.physics.soft.x.shape)
    )
    place = np.asarray(env.joint_start) if env is SMALL else 0.0  # small observes from the container
    np.testing.assert_array_equal(states.obs["target_q"], states.physics.task - place)
    np.testing.assert_array_equal(
        states.obs["particle_q"], env.cloud.pick(states.physics.soft.x[0])[None] - place + 0 * states.obs["particle_q"]
    )
    shift = np.asarray(states.physics.task) - np.asarray(env.joint_start)
    for values, low, high in zip(shift.T, (-0.2, 0.0, -0.2), (0.2, 0.3, 0.2), strict=True):
        assert low - 1e-6 <= values.min() < low + 0.01 and high - 0.01 < values.max() <= high + 1e-6
        assert values.mean() == pytest.approx(0.5 * (low + high), abs=0.03)
        steps = values / (max(abs(low), abs(high)) / 1000)
        assert np.abs(steps - np.round(steps)).max() < 0.01


@pytest.mark.parametrize("env", [PAPER, SMALL])
@pytest.mark.parametrize("distance", [0.0, 0.0199, 0.0201, 0.3])
def test_reward_is_the_formula(env, distance):
    x, place = np.array(env.rest_positions, np.float64), np.array([0.4, 0.4, 0.5])
    x += place - np.asarray(env.joint_start)
    x[0] = place + [0.0, 0.5, 0.0]  # one observed particle far above
    seen = x[:: env.cloud.stride][: env.cloud.num_points]
    target = place + distance * np.array([0.6, 0.0, 0.8])
    state = soft_tasks.physics(env, x, joint_q=jnp.asarray(place, jnp.float32), task=jnp.asarray(target, jnp.float32))
    reward, metrics = env.reward(state)
    near = (1 / (1 + (distance / float(env.distance_scale)) ** 2)) ** 2
    far = (np.abs(seen - place) - np.asarray(env.outer)) / float(env.spill_width)
    spill = (1 / (1 + np.exp(-np.clip(far, -500, 500)))).max(axis=1).mean()
    assert spill >= 1 / env.cloud.num_points
    np.testing.assert_allclose(reward, 0.1 * near * (2 if distance <= 0.02 else 1) - spill, atol=1e-6)
    np.testing.assert_allclose(metrics["spill"], spill, atol=1e-6)
    assert float(metrics["success"]) == float(distance <= 0.02)


def test_the_papers_container_is_lifted_to_its_lowest_place_by_the_first_step():
    state = jax.jit(PAPER.step)(PAPER.reset(jax.random.key(0)), jnp.array([0.5, -1.0, 0.0]))
    np.testing.assert_allclose(state.obs["joint_q"], [0.505, 0.16, 0.5], atol=1e-6)
    assert int(state.status) == Status.OK


def test_at_small_a_policy_sees_neither_the_containers_place_nor_the_waters_middle():
    observed = {name: set(env.observation_spec) for name, env in (("paper", PAPER), ("small", SMALL))}
    assert observed["paper"] - observed["small"] == {"com_q", "joint_q"}


def test_water_stays_in_a_container_that_rests_or_moves_gently():
    for action in ([0.0, 0.0, 0.0], [0.2, 0.3, -0.2]):
        states = soft_tasks.run("FluidMove", soft_tasks.start("FluidMove"), action, 30)
        x, place = np.asarray(states[-1].physics.soft.x), np.asarray(states[-1].physics.joint_q)
        inside = np.abs(x - place) <= np.asarray(SMALL.outer)
        assert inside.all()
        assert all(int(s.status) == Status.OK for s in states)
        assert float(states[-1].metrics["spill"]) < 0.02


def test_a_container_that_is_jerked_about_spills():
    """At 1.5 m/s, three times as fast as an action can make it."""
    env = SMALL.replace(joint_step=jnp.full(3, 0.03))
    actions = jnp.repeat(jnp.array([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]]), 10, axis=0)
    last, spilt = jax.jit(
        lambda s: jax.lax.scan(lambda s, a: ((new := env.step(s, a)), new.metrics["spill"]), s, actions)
    )(soft_tasks.start("FluidMove"))
    assert float(spilt[-1]) > 0.05
    assert float(last.metrics["success"]) == 0.0


def test_the_target_is_drawn():
    physics = soft_tasks.start("FluidMove").physics
    shapes = SMALL.render_shapes(physics)
    assert [s["kind"] for s in shapes] == ["box"] * 5 + ["sphere"]
    np.testing.assert_array_equal(shapes[-1]["center"], physics.task)


@pytest.mark.slow
def test_gradient_by_actions_is_that_of_differences(x64):
    """The water splashes against the walls; three substeps a step."""
    env = fluid_move.small()
    env = env.replace(num_substeps=3, list_every=None, spill_width=jnp.asarray(0.05))
    errors = difference_errors(env, num_steps=4, scale=0.9, h=1e-7)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-4


@pytest.mark.slow
def test_gradient_where_limits_stop_the_container_is_that_of_differences_unless_they_are_frozen(x64):
    """The container may move by 4 mm in all, and an action moves it by up to 9 mm."""
    env = fluid_move.small()
    near = {"joint_lower": env.joint_start - 4e-3, "joint_upper": env.joint_start + 4e-3}
    env = env.replace(num_substeps=3, list_every=None, spill_width=jnp.asarray(0.05), **near)
    errors = difference_errors(env, num_steps=4, scale=0.9, h=1e-7)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-4
    frozen = difference_errors(env.replace(exact_limits=False), num_steps=4, scale=0.9, h=1e-7)
    assert frozen[:, 0].max() < 1e-9 and frozen[:, 1].min() > 0.1
