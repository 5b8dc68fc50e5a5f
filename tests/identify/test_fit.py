"""Fits whose answer is known by hand: found, doubted where data are silent, bounded, robust, the same every time."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sliding_block

import rewax
from rewax.envs.randomize import LogNormal, LogUniform, Normal, Uniform
from rewax.envs.randomize.stored import FORMAT
from rewax.identify import identify, load_result, minimize, one_sided_chamfer
from rewax.identify.evaluation import evaluate
from rewax.identify.fit import cut_off
from rewax.identify.starts import spread_starts
from rewax.identify.unknowns import space_of

BOTH = {"gain": LogUniform(0.2, 5.0), "softness": Uniform(0.2, 2.0)}


@pytest.fixture(scope="module")
def fitted():
    record = sliding_block.seen(sliding_block.block(gain=1.7, softness=0.6))
    return record, identify(sliding_block.block(), record, BOTH)


def test_the_numbers_are_found_with_honest_intervals(fitted):
    _, found = fitted
    assert found.values["gain"] == pytest.approx(1.7, rel=0.03)
    assert found.values["softness"] == pytest.approx(0.6, rel=0.06)
    for name, true in {"gain": 1.7, "softness": 0.6}.items():
        low, high = found.intervals[name]
        assert low < true < high and high - low < 0.5 * true
    assert not found.undetermined and found.failed == 0
    np.testing.assert_allclose(found.starts, np.tile(found.latent, (6, 1)), atol=0.15)  # from everywhere
    assert found.residual_by_frame.shape == (5,) and found.residual_by_frame.max() < 0.006


def test_a_second_fit_gives_the_same_bits_without_a_new_program(fitted):
    record, found = fitted
    programs = evaluate._cache_size()
    again = identify(sliding_block.block(gain=3.0), record, BOTH)  # leaves that are unknown do not count
    assert evaluate._cache_size() == programs
    np.testing.assert_array_equal(again.latent, found.latent)
    np.testing.assert_array_equal(again.covariance, found.covariance)


def test_what_data_do_not_determine_is_said():
    record = sliding_block.seen(sliding_block.block(gain=1.5, grip=0.8))
    unknowns = {"gain": LogUniform(0.2, 5.0), "grip": LogUniform(0.2, 5.0), "idle": Normal(1.0, 0.3)}
    found = identify(sliding_block.block(), record, unknowns, starts=2)
    assert found.values["gain"] * found.values["grip"] == pytest.approx(1.2, rel=0.03)
    said = " ".join(found.undetermined)
    assert "do not determine idle" in said and len(found.undetermined) == 2
    assert "gain^1 * grip^-1" in said or "grip^1 * gain^-1" in said
    assert found.values["idle"] == pytest.approx(1.0, abs=1e-3)  # stays at its prior
    low, high = found.intervals["idle"]
    assert high - low == pytest.approx(2 * 1.96 * 0.3, rel=0.05)


def test_one_fit_cannot_tell_what_placements_do_and_says_so():
    record = sliding_block.seen(sliding_block.block(gain=1.5))
    alone = identify(sliding_block.block(), record, {"gain": LogUniform(0.2, 5.0)}, starts=1)
    assert sum("One fit counts for each environment" in remark for remark in alone.remarks) == 1
    several = identify(sliding_block.block(), record, {"gain": LogUniform(0.2, 5.0)}, starts=2)
    assert not any("One fit counts" in remark for remark in several.remarks)


def test_an_environment_without_a_soft_body_is_said():
    record = sliding_block.seen(sliding_block.block())
    with pytest.raises(ValueError, match="CartpoleSwingUp has no soft body for a record"):
        identify(rewax.make("CartpoleSwingUp", scale="small"), record, {"gain": LogUniform(0.2, 5.0)})


def test_shared_names_share_a_number():
    record = sliding_block.seen(sliding_block.block(gain=1.3, softness=1.3))
    found = identify(sliding_block.block(), record, {("gain", "softness"): LogNormal(1.0, 0.7)}, starts=1)
    assert found.values["gain"] == pytest.approx(1.3, rel=0.03)
    env = found.fitted_env()
    assert float(env.gain) == float(env.softness) == pytest.approx(found.values["gain"], rel=1e-6)


def test_outliers_do_not_move_the_fit_much(fitted):
    record = sliding_block.seen(sliding_block.block(gain=1.7, softness=0.6), outliers=12)
    found = identify(sliding_block.block(), record, BOTH, starts=1)
    assert found.values["gain"] == pytest.approx(1.7, rel=0.12)


def test_failed_simulations_are_rejected_and_counted():
    record = sliding_block.seen(sliding_block.block(gain=1.7, softness=0.6))
    found = identify(sliding_block.block(limit=1.2), record, BOTH)
    assert found.values["gain"] <= 1.2 and found.failed > 0
    assert any("simulations failed and were rejected" in remark for remark in found.remarks)
    with pytest.raises(ValueError, match=r"no start has a valid simulation, status INVALID_PARAMETERS"):
        identify(sliding_block.block(limit=0.01), record, BOTH)


def test_a_finer_environment_goes_on_where_the_coarser_one_ended():
    """One of them is told that particles grip 20 % better, as another resolution would: the interval covers both."""
    record = sliding_block.seen(sliding_block.block(gain=1.5))
    unknowns = {"gain": LogUniform(0.2, 5.0)}
    alone = identify(sliding_block.block(), record, unknowns, shake=0.0)
    both = identify([sliding_block.block(), sliding_block.block(grip=1.2)], record, unknowns, shake=0.0)
    np.testing.assert_allclose(both.starts[:3] - both.starts[3:], np.log(1.2) / (np.log(25) / 12**0.5), atol=0.02)
    assert both.intervals["gain"][0] < 1.5 / 1.2 < 1.5 < both.intervals["gain"][1]
    assert both.covariance[0, 0] > 4.0 * alone.covariance[0, 0]
    assert both.values["gain"] == pytest.approx(1.5 / 1.2, rel=0.02)  # that of the last
    three = identify(3 * [sliding_block.block()], record, unknowns, starts=4, shake=0.0)
    assert len(three.starts) == 4 and three.values["gain"] == pytest.approx(1.5, rel=0.02)


def test_grids_may_leave_the_prior_and_the_result_may_not():
    """A grid makes the block slide further, by the factor exp(10 spacing): it finds a gain that is as much smaller."""
    grids, unknowns = [sliding_block.on_grid(0.04), sliding_block.on_grid(0.02)], {"gain": LogUniform(0.2, 5.0)}

    def found(gain):
        record = sliding_block.seen(sliding_block.block(gain=gain))
        return identify(grids, record, unknowns, starts=4, shake=0.0, limit=0.0)

    inside, beyond, outside = found(1.5), found(0.25), found(0.12)
    assert inside.values["gain"] == pytest.approx(1.5, rel=0.02)
    numbers = [float(beyond.space.numbers(one)[0]) for one in (beyond.starts[0], beyond.starts[-1])]
    np.testing.assert_allclose(numbers, 0.25 * np.exp([-0.4, -0.2]), rtol=0.06)  # the first is below 0.2
    assert beyond.values["gain"] == pytest.approx(0.25 * np.exp(-0.1), rel=0.06)  # half of the way
    assert beyond.intervals["gain"][0] < 0.25 < beyond.intervals["gain"][1]
    assert any("gain leaves its prior on the coarsest grid" in remark for remark in beyond.remarks)
    assert not any("coarsest grid" in remark for remark in inside.remarks)
    assert outside.values["gain"] == pytest.approx(0.2, rel=1e-6) and outside.at_bound == ["gain"]
    assert any("gain lies at a bound of the search" in remark for remark in outside.remarks)


def test_a_frame_of_weight_zero_counts_for_nothing():
    record = sliding_block.seen(sliding_block.block(gain=1.7, softness=0.6))
    spoilt = record.clouds.copy()
    spoilt[4] += 0.02
    weights = np.array([1.0, 1.0, 1.0, 1.0, 0.0])
    one, other = (
        identify(sliding_block.block(), r, BOTH, starts=1, frame_weights=weights, shake=0.0)
        for r in (
            record,
            sliding_block.seen(sliding_block.block(gain=1.7, softness=0.6)).__class__(
                **{**vars(record), "clouds": spoilt}
            ),
        )
    )
    np.testing.assert_allclose(one.latent, other.latent, atol=5e-3)


def test_a_result_is_read_back_as_environment_and_distribution(fitted, tmp_path):
    _, found = fitted
    saved = load_result(found.save(tmp_path / "result.json"))
    env = saved.apply(sliding_block.block())
    assert float(env.gain) == pytest.approx(found.values["gain"], rel=1e-6)
    keys = jax.random.split(jax.random.key(0), 2000)
    gains = jax.vmap(lambda key: saved.draws(key, sliding_block.block()).gain)(keys)
    low, high = found.intervals["gain"]
    assert 0.93 < float(((gains > low) & (gains < high)).mean()) < 0.97
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(ValueError, match="is no result of this version"):
        load_result(tmp_path / "bad.json")
    (tmp_path / "brief.json").write_text(json.dumps({"format": FORMAT, "values": {}, "unknowns": []}))
    assert load_result(tmp_path / "brief.json").made_by is None
    with pytest.raises(ValueError, match="there is no result"):
        load_result(tmp_path / "absent.json")


def test_adam_finds_the_same_with_a_loss_of_the_user(fitted):
    record, _ = fitted
    lowest = minimize(sliding_block.block(), record, BOTH, one_sided_chamfer, iterations=60, learning_rate=0.1)
    assert lowest.losses[-1] < 0.5 * lowest.losses[0]  # points on the surface stay half a spacing from the particles
    assert lowest.values["gain"] == pytest.approx(1.7, rel=0.12)
    for weights in (np.ones((5, 1)), np.ones(3), np.zeros(5)):
        with pytest.raises(ValueError, match="give 5 numbers of at least 0, not all 0"):
            minimize(sliding_block.block(), record, BOTH, one_sided_chamfer, frame_weights=weights)
    for options in ({"iterations": 0}, {"learning_rate": 0.0}, {"learning_rate": float("nan")}):
        with pytest.raises(ValueError, match=r"^(iterations|learning_rate) is (0|0.0|nan): give "):
            minimize(sliding_block.block(), record, BOTH, one_sided_chamfer, **options)
    with pytest.raises(ValueError, match="loss or its gradient is not finite at the median of the priors"):
        minimize(sliding_block.block(), record, BOTH, lambda x, cloud, mask: jnp.nan * x.sum(), iterations=1)
    held = minimize(sliding_block.block(limit=1.2), record, BOTH, one_sided_chamfer, iterations=30)
    assert held.failed > 0 and held.values["gain"] <= 1.2


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"starts": 0}, "starts is 0"),
        ({"horizons": (0.5,)}, "rising shares above 0 that end with 1"),
        ({"shake": 1.0}, "shake is 1.0"),
        ({"frame_weights": np.ones(3)}, "give 5 numbers"),
        ({"frame_weights": np.array([1.0, np.nan, 1.0, 1.0, 1.0])}, "give 5 numbers"),
        ({"frame_weights": np.eye(5)[0]}, "one above 0 after the first"),
        ({"noise": -0.001}, "noise is -0.001: give a length in metres, above 0"),
        ({"width": 0.0}, "width is 0.0"),
        ({"max_iterations": 0}, "max_iterations is 0: give at least 1"),
        ({"side_by_side": 0}, "side_by_side is 0"),
        ({"unknowns": {"initial.velocity[0]": Uniform(-1.0, 1.0)}}, "is of a soft body, and .* has none"),
        ({"limit": 0.0}, "limit is 0.0 with spacings of the grid of nan m: give at least two environments"),
        ({"unknowns": {"weight": LogUniform(1.0, 2.0)}}, "has no parameter 'weight'"),
        ({"unknowns": {"initial.spin": Uniform(1.0, 2.0)}}, "is no unknown of the first state"),
    ],
)
def test_bad_options_are_refused(fitted, options, sentence):
    record, _ = fitted
    with pytest.raises(ValueError, match=sentence):
        identify(sliding_block.block(), record, **{"unknowns": BOTH, **options})


def test_starts_cover_the_priors_and_keep_the_bounds():
    space = space_of(BOTH, sliding_block.block())
    low, high = space.bounds
    starts = spread_starts(space, 5, low, np.minimum(high, 0.5), 0)
    assert starts.shape == (5, 2) and not starts[0].any() and starts.max() <= 0.5
    assert all(len(np.unique(starts[1:, i])) == 4 for i in range(2))


def test_latent_coordinates_are_standard_under_the_prior():
    space = space_of(BOTH | {"grip": LogNormal(2.0, 0.3), "idle": Normal(1.0, 0.2)}, sliding_block.block())
    key = jax.random.key(0)
    draws = np.stack([np.asarray(prior.sample(key, (4000,), jnp.float32)) for prior in space.priors], -1)
    latent = np.stack([space.latent(row) for row in draws])
    np.testing.assert_allclose(latent.mean(0), 0.0, atol=0.06)
    np.testing.assert_allclose(latent.std(0), 1.0, atol=0.04)
    np.testing.assert_allclose(np.stack(space.numbers(latent), -1), draws, rtol=1e-5)


def test_an_interval_that_ends_at_the_end_of_its_prior_is_named():
    space = space_of({"gain": LogUniform(0.1, 1.0)}, sliding_block.block())
    low, high = (bound.item() for bound in space.bounds)
    middle, width = 0.5 * (low + high), high - low

    def said(latent, std):
        return cut_off(space, np.array([latent]), np.array([[std**2]]))

    assert said(middle, 0.1 * width) == []
    assert said(high - 0.1 * width, 0.1 * width) == [
        "The interval of gain ends at the upper end of its prior: a wider prior gives a wider interval."
    ]
    assert "the lower end of its prior" in said(low + 0.1 * width, 0.1 * width)[0]
    assert "both ends of its prior" in said(middle, width)[0]
