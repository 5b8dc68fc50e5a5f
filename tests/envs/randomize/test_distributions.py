"""Draws lie where they should, with the moments that theory gives; numbers that cannot be are refused."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rewax.envs.randomize import Choice, Constant, LogNormal, LogUniform, Normal, Per, Scale, Shift, Uniform

NUM = 20_000
CUT = math.exp(-0.5) / math.sqrt(2 * math.pi) / (0.5 - 0.5 * math.erf(1 / math.sqrt(2)))  # mean of a normal above 1 std

CASES = {  # distribution: lowest and highest legal draw, mean, standard deviation
    Uniform(-1.0, 3.0): (-1.0, 3.0, 1.0, 4.0 / math.sqrt(12.0)),
    LogUniform(0.5, 2.0): (0.5, 2.0, 1.5 / math.log(4.0), 0.4234),
    Normal(2.0, 0.5): (-math.inf, math.inf, 2.0, 0.5),
    Normal(2.0, 0.5, low=1.5, high=2.5): (1.5, 2.5, 2.0, 0.2698),
    Normal(0.0, 1.0, low=1.0): (1.0, math.inf, CUT, 0.4462),
    LogNormal(2.0, 0.3): (
        0.0,
        math.inf,
        2.0 * math.exp(0.045),
        2.0 * math.exp(0.045) * math.sqrt(math.exp(0.09) - 1.0),
    ),
    LogNormal(1.0, 0.5, low=0.8, high=1.5): (0.8, 1.5, 1.1001, 0.1949),
    Choice((1.0, 2.0, 6.0)): (1.0, 6.0, 3.0, math.sqrt(14.0 / 3.0)),
    Choice((1.0, 5.0), weights=(3.0, 1.0)): (1.0, 5.0, 2.0, math.sqrt(3.0)),
    Constant(0.1): (0.1, 0.1, 0.1, 0.0),
}


@pytest.mark.parametrize("distribution", CASES, ids=str)
def test_draws_lie_in_range_with_mean_and_spread(distribution):
    low, high, mean, std = CASES[distribution]
    drawn = np.asarray(distribution.sample(jax.random.key(0), (NUM,), jnp.float32))
    assert drawn.dtype == np.float32 and drawn.min() >= np.float32(low) and drawn.max() <= np.float32(high)
    error = std / math.sqrt(NUM)
    assert (
        abs(drawn.mean(dtype=float) - mean) <= 4.0 * error + 1e-7
        and abs(drawn.std(dtype=float) - std) <= 0.02 * std + 1e-7
    )
    np.testing.assert_array_equal(drawn, distribution.sample(jax.random.key(0), (NUM,), jnp.float32))


@pytest.mark.parametrize(
    ("low", "high"), [(4.9, math.inf), (-math.inf, -4.0), (3.0, 10.0), (-1.0, math.inf), (-2.0, 1.0)]
)
def test_draws_from_a_tail_are_those_of_a_truncated_normal_distribution(low, high):
    drawn = np.asarray(Normal(0.0, 1.0, low=low, high=high).sample(jax.random.key(0), (300_000,), jnp.float32))
    assert np.abs(drawn).max() < 8.0
    shares = (0.01, 0.5, 0.99)
    np.testing.assert_allclose(np.quantile(drawn, shares), stats.truncnorm(low, high).ppf(shares), atol=0.03)


def test_the_logarithm_of_a_log_uniform_draw_is_uniform():
    drawn = np.log(LogUniform(0.1, 10.0).sample(jax.random.key(1), (NUM,), jnp.float32))
    counts, _ = np.histogram(drawn, bins=10, range=(math.log(0.1), math.log(10.0)))
    np.testing.assert_allclose(counts, NUM / 10, rtol=0.1)


def test_only_the_values_are_chosen():
    drawn = Choice((0.1, 0.7)).sample(jax.random.key(2), (3, 5), jnp.float32)
    assert drawn.shape == (3, 5) and {*np.asarray(drawn).ravel()} == {np.float32(0.1), np.float32(0.7)}


def test_equal_distributions_are_equal_and_have_one_hash():
    assert Uniform(0, 1) == Uniform(0.0, 1.0) and hash(Uniform(0, 1)) == hash(Uniform(np.float32(0.0), 1.0))
    assert Choice([1, 2]) == Choice((1.0, 2.0)) and hash(Scale(Choice([1, 2]))) == hash(Scale(Choice((1.0, 2.0))))
    assert Uniform(0.0, 1.0) != Uniform(0.0, 1.0, per=Per.ROW) and Scale(Constant(1.0)) != Shift(Constant(1.0))


REFUSED = {
    r"^Uniform.low is 2.0: give a number below high, which is 1.0, or use Constant$": lambda: Uniform(2.0, 1.0),
    r"^Uniform.high is inf: give a finite number$": lambda: Uniform(0.0, math.inf),
    r"^Uniform.low is nan: give a number$": lambda: Uniform(math.nan, 1.0),
    r"^Uniform.low is '0': give one number$": lambda: Uniform("0", 1.0),
    r"^Uniform.high is \[1.0, 2.0\]: give one number$": lambda: Uniform(0.0, [1.0, 2.0]),
    r"^Uniform.low is None: give one number$": lambda: Uniform(None, 1.0),
    r"^Uniform.per is 'row': give Per.LEAF, Per.ROW or Per.ELEMENT$": lambda: Uniform(0.0, 1.0, per="row"),
    r"^LogUniform.low is 0.0: give a number above 0, or use Uniform$": lambda: LogUniform(0.0, 1.0),
    r"^LogNormal.median is 0.0: give a finite number above 0$": lambda: LogNormal(0.0, 1.0),
    r"^LogNormal.log_std is 0.0: give a finite number above 0$": lambda: LogNormal(1.0, 0.0),
    r"^LogNormal.low is -1.0: give one from 0 to below high, inf$": lambda: LogNormal(1.0, 1.0, low=-1.0),
    r"^LogNormal.low is 9.0: give one within 5 log_std of the median": lambda: LogNormal(1.0, 0.1, low=9.0),
    r"^Normal.std is 0.0: give a finite number above 0, or use Constant$": lambda: Normal(1.0, 0.0),
    r"^Normal.mean is inf: give a finite number$": lambda: Normal(math.inf, 1.0),
    r"^Normal.low is 1.0: give a number below high, which is 0.0$": lambda: Normal(0.0, 1.0, low=1.0, high=0.0),
    r"^Normal.low is 9.0: give one within 5 std of the mean, 0.0 with std 1.0$": lambda: Normal(0.0, 1.0, low=9.0),
    r"^Normal.high is -9.0: give one within 5 std of the mean": lambda: Normal(0.0, 1.0, high=-9.0),
    r"^Choice.values is \(\): give a tuple of numbers$": lambda: Choice(()),
    r"^Choice.values is 1.0: give a tuple of numbers$": lambda: Choice(1.0),
    r"^Choice.values\[1\] is inf: give a finite number$": lambda: Choice((1.0, math.inf)),
    r"^Choice.weights is \(1.0,\): give one for each of the 2 values$": lambda: Choice((1.0, 2.0), weights=(1.0,)),
    r"^Choice.weights\[0\] is 0.0: give a finite number above 0$": lambda: Choice((1.0, 2.0), weights=(0.0, 1.0)),
    r"^Constant.value is inf: give a finite number$": lambda: Constant(math.inf),
    r"^Scale.by is 2.0: give a distribution, as in Scale\(Uniform\(0.5, 2.0\)\)$": lambda: Scale(2.0),
    r"^Shift.by is Scale\(.*: give a distribution, as in Shift\(": lambda: Shift(Scale(Uniform(0.0, 1.0))),
}


@pytest.mark.parametrize("sentence", REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_is_refused_at_construction(sentence):
    with pytest.raises(ValueError, match=sentence):
        REFUSED[sentence]()
