"""Points of a search are computed in threads, and only as far as the horizon."""

import jax.numpy as jnp
import numpy as np
import pytest
import sliding_block

import rewax
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomize import LogUniform, Uniform
from rewax.identify.evaluation import evaluate
from rewax.identify.simulate import data_of, simulated_frames, up_to
from rewax.identify.starts import placements_of, program, spread_starts
from rewax.identify.unknowns import space_of

UNKNOWNS = {"gain": LogUniform(0.2, 5.0), "softness": Uniform(0.2, 2.0)}
POINTS = 5


@pytest.fixture(scope="module")
def fit():
    env = sliding_block.block()
    record = sliding_block.seen(sliding_block.block(gain=1.7, softness=0.6))
    return env, space_of(UNKNOWNS, env), data_of(record, 0.02, 4)


def test_a_horizon_leaves_out_the_steps_after_its_frames(fit):
    env, space, data = fit
    latent = jnp.asarray([0.3, -0.2])
    every, _ = simulated_frames(env, space, latent, data)
    half, _ = simulated_frames(env, space, latent, up_to(data, 0.5))
    all_of_them, _ = simulated_frames(env, space, latent, up_to(data, 1.0))
    steps = np.asarray(data.before + data.fraction)
    within = steps <= 0.5 * steps[-1]
    assert 1 < within.sum() < len(steps)
    np.testing.assert_array_equal(half[within], every[within])
    np.testing.assert_array_equal(all_of_them, every)
    np.testing.assert_array_equal(half[-1], half[np.flatnonzero(within)[-1] + 1])  # it rests
    assert np.abs(np.asarray(half[-1] - every[-1])).max() > 1e-3


def test_threads_give_the_bits_of_one_point_after_the_other(fit):
    env, space, data = fit
    points = spread_starts(space, POINTS, *space.bounds, 0)
    placed = placements_of(env, POINTS, 0.4, 0.02, 0)
    given = {"horizon": 1.0, "weights": np.ones(len(data.before)), "deviation": 0.002}
    one, three = (program(env, space, data, None, count, placed)(points, **given) for count in (1, 3))
    for a, b in zip(one, three, strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(np.unique(one.cost)) == POINTS
    needed = np.array([False, True, False, False, True])
    some = program(env, space, data, None, 3, placed)(points, needed, **given)
    np.testing.assert_array_equal(some.cost, np.where(needed, one.cost, 0.0))


def test_the_gradient_is_that_of_the_cost_also_where_the_first_frame_moves():
    """The first frame fixes the offsets of the surface. Here it shows the block after one control step."""
    env = sliding_block.block()
    record = sliding_block.seen(sliding_block.block(gain=1.7), frames=(0.1, 0.3, 0.5, 0.8))
    space = space_of({"gain": LogUniform(0.2, 5.0)}, env)
    data, weights = data_of(record, 0.03, 4), jnp.array([0.0, 1.0, 1.0, 1.0])
    at, h = np.array([[-0.5], [0.2], [0.9]], np.float32), 0.02

    def found(latents):
        deviation = jnp.float32(0.01)
        return evaluate(
            jnp.asarray(latents),
            None,
            EnvLeaves.of(env),
            data,
            weights,
            deviation,
            space=space,
            residuals=None,
            num_regions=16,
        )

    difference = np.asarray(found(at + h).cost - found(at - h).cost) / (2 * h)
    np.testing.assert_allclose(found(at).gradient[:, 0], difference, rtol=0.02)


@pytest.mark.parametrize("name", ["WhipRope", "SoftJumper"])
def test_vertices_of_meshes_stay_where_they_are(name):
    assert placements_of(rewax.make(name, scale="small"), 2, 0.4, 0.01, 0) is None
    assert placements_of(rewax.make("RollingFlat", scale="small"), 2, 0.4, 0.01, 0) is not None
