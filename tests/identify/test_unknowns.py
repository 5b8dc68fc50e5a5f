"""The stable part of a prior, and unknowns of the first state, on a task of particles."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sliding_block

import rewax
from rewax import struct
from rewax.envs.history import History
from rewax.envs.named_sensors import with_sensors
from rewax.envs.randomize import LogUniform, Uniform, hook
from rewax.envs.randomized import Randomized
from rewax.identify.simulate import without_reset_noise
from rewax.identify.unknowns import is_stable, space_of, stable_bounds
from rewax.physics import mpm
from rewax.status import Status

MODULUS = "scene.material.elasticity.youngs_modulus"


@pytest.fixture(scope="module")
def env():
    return rewax.make("RollingFlat", scale="small")


def test_the_search_ends_where_the_substep_becomes_unstable(env):
    space = space_of({MODULUS: LogUniform(50.0, 5000.0)}, env)
    low, high, said = stable_bounds(space, (env,))
    stiffest = space.place(env, jnp.asarray(high))
    limit = float(mpm.largest_stable_dt(stiffest.scene.material, env.scene.grid))
    assert env.scene.dt == pytest.approx(limit, rel=2e-3) and is_stable(stiffest)
    assert low[0] == pytest.approx(space.bounds[0][0]) and len(said) == 1
    assert "instead of 5000: beyond, the substep is too long" in said[0]
    action, step = jnp.zeros(3), jax.jit(lambda e, a: e.step(e.reset(jax.random.key(0)), a).status)
    assert not int(step(stiffest, action)) & Status.INVALID_PARAMETERS
    beyond = space.place(env, jnp.asarray(high + 0.02))
    assert not is_stable(beyond) and int(step(beyond, action)) & Status.INVALID_PARAMETERS


def test_a_search_beyond_the_priors_is_stable_too_and_says_only_what_the_priors_lose(env):
    space = space_of({MODULUS: LogUniform(50.0, 300.0)}, env)
    low, high, said = stable_bounds(space, (env,), 1.0)
    np.testing.assert_allclose([low, high], [space.bounds[0] - 1.0, space.bounds[1] + 1.0])
    assert not said
    _, far, said = stable_bounds(space, (env,), 9.0)
    assert high[0] < far[0] < space.bounds[1][0] + 9.0 and is_stable(space.place(env, jnp.asarray(far)))
    assert not said
    wider = space_of({MODULUS: LogUniform(50.0, 5000.0)}, env)
    assert "to 5000: beyond" not in stable_bounds(wider, (env,), 1.0)[2][0]
    assert "instead of 5000: beyond, the substep is too long" in stable_bounds(wider, (env,), 1.0)[2][0]


def test_a_finer_substep_leaves_the_prior_whole_and_a_stiff_one_is_refused(env):
    fine = rewax.make("RollingFlat", scale="small", num_substeps=30)
    space = space_of({MODULUS: LogUniform(50.0, 3000.0)}, fine)
    low, high, said = stable_bounds(space, (fine,))
    np.testing.assert_allclose([low, high], space.bounds)
    assert not said
    assert stable_bounds(space, (fine, env))[1][0] < high[0]  # the coarser substep of several counts
    stiff = space_of({MODULUS: LogUniform(5e3, 5e4)}, env)
    with pytest.raises(ValueError, match="the substep is too long for the median of the priors"):
        stable_bounds(stiff, (env,))


def test_the_first_state_may_be_unknown(env):
    unknowns = {"initial.position[0]": Uniform(-0.1, 0.1), "initial.velocity[1]": Uniform(-1.0, 1.0)}
    still = without_reset_noise(env)
    space = space_of(unknowns, still)
    physics = jax.jit(still.reset)(jax.random.key(0)).physics
    moved = space.start(physics, jnp.asarray(space.latent([0.02, -0.5]), jnp.float32))
    np.testing.assert_allclose(moved.soft.x - physics.soft.x, np.tile([0.02, 0.0, 0.0], (256, 1)), atol=1e-6)
    np.testing.assert_allclose(moved.soft.v, np.tile([0.0, -0.5, 0.0], (256, 1)), atol=1e-6)


def test_without_reset_noise_all_episodes_begin_alike(env):
    still = without_reset_noise(env)
    reset = jax.jit(still.reset)
    a, b = (reset(jax.random.key(seed)).physics.soft.x for seed in (0, 1))
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(a, env.rest_positions)


def test_a_wrapped_task_is_simulated_without_its_reset_noise(env):
    wrapped = without_reset_noise(History(env=with_sensors(env, ("labels",), 8), steps=2))
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(wrapped.noise)) and wrapped.steps == 2
    assert any(np.any(leaf) for leaf in jax.tree.leaves(env.noise))


def test_an_environment_that_draws_its_parameters_is_refused(env):
    """The draw would take the place of an unknown, whose gradient would be zero."""
    drawing = Randomized(env=env, randomize=hook({MODULUS: Uniform(1e3, 2e3)}))
    for one in (drawing, History(env=drawing, steps=2)):
        with pytest.raises(ValueError, match=r"each reset would replace .* env\.randomize\(key, env\.env\)"):
            without_reset_noise(one)
    without_reset_noise(drawing.randomize(jax.random.key(0), drawing.env))


def test_unknowns_that_share_a_number_are_refused(env):
    with pytest.raises(ValueError, match="is drawn twice"):
        space_of({MODULUS: LogUniform(1e3, 2e3), f".{MODULUS}": LogUniform(1e3, 2e3)}, env)


def test_what_a_task_draws_at_its_start_is_left_out_or_named():
    towel = without_reset_noise(rewax.make("FoldCloth", scale="small"))
    np.testing.assert_allclose(jax.jit(towel.reset)(jax.random.key(3)).physics.soft.x, towel.rest_positions, atol=1e-6)

    @struct.dataclass
    class Thrown(sliding_block.SlidingBlock):
        def reset(self, key):
            state = sliding_block.SlidingBlock.reset(self, key)
            return state.replace(physics=state.physics.replace(shift=jax.random.uniform(key)))

    block = sliding_block.block()
    thrown = Thrown(**{field.name: getattr(block, field.name) for field in dataclasses.fields(block)})
    with pytest.raises(ValueError, match=r"^episodes of Thrown begin differently .* name the sizes .* in noise_fields"):
        without_reset_noise(thrown)
    assert without_reset_noise(block) is block


@pytest.mark.parametrize(
    ("task", "names"),
    [
        ("PourBag", (".scene.particles.material.elasticity.youngs_modulus",)),
        ("FoldCloth", (".scene.cloth.warp",)),
        ("SoftJumper", (".scene.mu", ".scene.lam")),
    ],
)
def test_stability_is_that_of_every_solver(task, names):
    """The status of a step says INVALID_PARAMETERS where the scene is not stable, and only there."""
    env = rewax.make(task, scale="small")
    state = jax.jit(env.reset)(jax.random.key(0))
    check = jax.jit(lambda env: env.step(state, jnp.zeros(env.action_spec.shape)).status)
    for factor in (1.0, 1e4):
        scale = lambda path, a: a * factor if jax.tree_util.keystr(path) in names else a  # noqa: E731
        changed = jax.tree.map_with_path(scale, env)
        assert is_stable(changed) == (factor == 1.0) == (not int(check(changed)) & Status.INVALID_PARAMETERS)
