"""Intervals of linear problems hold as often as they claim; directions without data are named."""

import dataclasses

import jax
import numpy as np
import pytest

from rewax.envs.randomize import LogUniform, Uniform
from rewax.identify.result import Identified
from rewax.identify.uncertainty import combined, posterior, short, undetermined
from rewax.identify.unknowns import Space

SPACE = Space((
    (("scene.a",), LogUniform(1.0, 10.0)), (("scene.b",), LogUniform(1.0, 10.0)), (("c",), Uniform(0.0, 1.0)),
))  # fmt: skip


@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_intervals_hold_where_errors_are_shared_within_a_region(shared):
    """1000 linear fits with 16 regions of 40 points: 95 % intervals hold for independent and for shared errors."""
    generator, held = np.random.Generator(np.random.PCG64(0)), []
    for _ in range(1000):
        jacobian = generator.normal(size=(16, 40, 1)) + 1.0
        noise = generator.normal(size=(16, 40)) + shared * generator.normal(size=(16, 1))
        hessian = np.einsum("rni,rnj->ij", jacobian, jacobian)
        estimate = np.linalg.solve(hessian, np.einsum("rni,rn->i", jacobian, noise))
        scores = np.einsum("rni,rn->ri", jacobian, noise - jacobian @ estimate)
        std = float(np.sqrt(posterior(hessian, scores, np.zeros((1, 1)))[0, 0]))
        held.append(abs(estimate[0]) < 1.96 * std)
    assert 0.92 < np.mean(held) <= 1.0


def test_no_data_leave_the_prior_and_much_data_leave_little():
    none = posterior(np.zeros((2, 2)), np.zeros((16, 2)), np.zeros((2, 2)))
    np.testing.assert_allclose(none, np.eye(2), atol=1e-6)
    much = posterior(1e6 * np.eye(2), np.zeros((16, 2)), np.zeros((2, 2)))
    np.testing.assert_allclose(much, 1e-6 * np.eye(2), rtol=1e-3)


def test_the_scatter_of_placements_adds_to_the_variance():
    between = np.diag([0.04, 0.0])
    total = posterior(1e4 * np.eye(2), np.zeros((16, 2)), between)
    np.testing.assert_allclose(np.diag(total), [1 / (1 + 1 / 0.0401), 1 / (1 + 1e4)], rtol=1e-3)
    assert not combined(np.ones((1, 2)), np.zeros(1, int))[1].any()


@pytest.mark.parametrize("count", [2, 3, 6, 30])
def test_the_interval_of_few_fits_holds_for_one_more_draw(count):
    generator, held = np.random.Generator(np.random.PCG64(1)), []
    for _ in range(4000):
        draws = generator.normal(size=(count + 1, 1))
        reach = 1.96 * np.sqrt(combined(draws[1:], np.zeros(count, int))[1][0, 0])
        held.append(abs(draws[0, 0] - draws[1:].mean()) < reach)
    assert np.mean(held) == pytest.approx(0.95, abs=0.015)


def test_words_name_the_direction():
    a = np.array([1.0, 0.0, 0.0])
    (said,) = undetermined(SPACE, 0.01 * np.eye(3) + 0.8 * np.outer(a, a))
    assert said == "The data do not determine a: 90 % of the prior's standard deviation is left."
    along = np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    (said,) = undetermined(SPACE, 0.01 * np.eye(3) + 0.63 * np.outer(along, along))
    assert "determine a^1 * b^-1: 80 %" in said or "determine b^1 * a^-1: 80 %" in said
    mixed = np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)
    (said,) = undetermined(SPACE, 0.01 * np.eye(3) + 0.63 * np.outer(mixed, mixed))
    assert "the combination" in said and "c" in said
    assert undetermined(SPACE, 0.01 * np.eye(3)) == []
    assert (
        short("scene.material.youngs_modulus") == "youngs_modulus"
        and short("initial.velocity[0]") == "initial.velocity[0]"
    )


def test_the_finest_environment_gives_the_result_and_the_others_doubt():
    latents, groups = np.array([[1.0], [3.0], [2.0], [3.0]]), np.array([0, 1, 0, 1])
    mean, covariance = combined(latents, groups)
    assert mean[0] == 3.0 and covariance[0, 0] > 1.5**2
    np.testing.assert_allclose(combined(np.array([[1.0], [3.0]]), np.array([0, 1]))[1], [[4.0]])


def test_errors_in_proportion_to_the_spacing_are_extrapolated_away():
    spacings, groups = np.array([0.04, 0.03]), np.array([0, 0, 1, 1])
    latents = np.array([2.0, -1.0]) + 50.0 * np.outer(spacings[groups], [1.0, 0.0])
    for limit, truth in ((0.0, [2.0, -1.0]), (0.02, [3.0, -1.0])):
        mean, covariance = combined(latents, groups, spacings, limit)
        np.testing.assert_allclose(mean, truth, atol=1e-12)
        np.testing.assert_allclose(covariance, np.diag([0.25 * (50.0 * (0.03 - limit)) ** 2, 0.0]), atol=1e-12)
    alone, _ = combined(latents[2:], groups[2:], spacings, 0.0)  # the coarser one has failed: nothing to extrapolate
    np.testing.assert_allclose(alone, latents[3])


def test_a_coordinate_whose_coarsest_fit_leaves_its_prior_goes_half_of_the_way():
    latents, groups, spacings = np.array([[2.0, 1.5], [1.0, 1.0]]), np.array([0, 1]), np.array([0.04, 0.02])
    mean, covariance = combined(latents, groups, spacings, 0.0, np.array([False, True]))
    np.testing.assert_allclose(mean, [0.0, 0.75])  # the line through both ends at [0.0, 0.5]
    np.testing.assert_allclose(covariance, 0.25 * np.outer([1.0, 0.5], [1.0, 0.5]))  # its doubt remains


def test_the_interval_of_an_extrapolation_holds_for_one_more_draw():
    generator, held = np.random.Generator(np.random.PCG64(2)), []
    groups, spacings = np.repeat([0, 1], 4), np.array([0.04, 0.03])
    for _ in range(4000):
        draws = generator.normal(size=(9, 1))
        mean, covariance = combined(draws[1:], groups, spacings, 0.02)
        held.append(abs(draws[0, 0] - mean[0]) < 1.96 * np.sqrt(covariance[0, 0]))
    assert 0.94 < np.mean(held) < 0.98  # half of the step counts as well


def posterior_of(prior, latent, covariance, bound):
    fit = dict.fromkeys(field.name for field in dataclasses.fields(Identified))
    numbers = {"latent": np.array([latent]), "covariance": np.array([[covariance]])}
    found = Identified(
        **{**fit, **numbers, "space": Space(((("a",), prior),)), "bounds": (np.array([-bound]), np.array([bound]))}
    )
    ((_, drawn),) = found.draws().draws
    return found, drawn


@pytest.mark.parametrize("prior", [Uniform(1.0, 3.0), LogUniform(1.0, 3.0)])
def test_a_value_extrapolated_beyond_the_stable_range_has_a_posterior(prior):
    for latent in (-1.5, 1.5):
        found, drawn = posterior_of(prior, latent, 1e-8, 0.5)  # a bound 10,000 standard deviations away
        assert found.values["a"] in (drawn.low, drawn.high)
        sample = drawn.sample(jax.random.key(0), (), float)
        assert float(sample) == pytest.approx(found.values["a"], rel=1e-3)


def test_the_posterior_of_a_small_number_is_as_narrow_as_its_fit():
    _, drawn = posterior_of(Uniform(1e-7, 3e-7), 0.0, 0.01, 1.7)
    assert drawn.mean == pytest.approx(2e-7) and drawn.std == pytest.approx(0.1 * 2e-7 / 12**0.5)
