"""Distributions of a number, and how the drawn number changes a parameter: as its value, a factor or a shift.

All are frozen and compare by value, so that equal ones share compiled programs.
"""

import dataclasses
import enum
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri

from rewax.types import Array, Key

_MAX_STDS = 5.0
"""The bounds of a truncated normal distribution must reach within this many std of its mean, or float32 fails."""


class Per(enum.Enum):
    """The parts of a parameter that get a number of their own."""

    LEAF = "leaf"
    """One number for the whole parameter."""
    ROW = "row"
    """One number for each entry of the first axis: for each body of a model, for example."""
    ELEMENT = "element"
    """One number for each element."""


@dataclasses.dataclass(frozen=True)
class Distribution:
    """Base of all distributions.

    Attributes:
      per: the parts of a parameter that get a number of their own.

    Raises:
      ValueError: a field is no number, or an illegal one. The message names class, field and remedy.
    """

    per: Per = dataclasses.field(default=Per.LEAF, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.per, Per):
            raise ValueError(f"{self._called}.per is {self.per!r}: give Per.LEAF, Per.ROW or Per.ELEMENT")
        for field in dataclasses.fields(self):
            if field.type is float:
                object.__setattr__(self, field.name, self._number(field.name, getattr(self, field.name)))

    def sample(self, key: Key, shape: tuple[int, ...], dtype: Any) -> Array:
        """Independent draws of this shape and dtype. Gradient: none; the numbers of a distribution are constants."""
        raise NotImplementedError

    @property
    def _called(self) -> str:
        return type(self).__name__

    def _number(self, name: str, value: Any) -> float:
        if isinstance(value, (bool, str)) or np.ndim(value) != 0:
            raise ValueError(f"{self._called}.{name} is {value!r}: give one number")
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise ValueError(f"{self._called}.{name} is {value!r}: give one number") from None
        self._require(not math.isnan(number), name, number, "give a number")
        return number

    def _require(self, legal: bool, name: str, value: Any, remedy: str) -> None:
        if not legal:
            raise ValueError(f"{self._called}.{name} is {value}: {remedy}")


@dataclasses.dataclass(frozen=True)
class Constant(Distribution):
    """Always ``value``, which must be finite."""

    value: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(math.isfinite(self.value), "value", self.value, "give a finite number")

    def sample(self, key: Key, shape: tuple[int, ...], dtype: Any) -> Array:
        del key
        return jnp.full(shape, self.value, dtype)


@dataclasses.dataclass(frozen=True)
class Uniform(Distribution):
    """Uniform from ``low`` to ``high``. Both are finite, and low < high."""

    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_range(self, self.low, self.high)

    def sample(self, key: Key, shape: tuple[int, ...], dtype: Any) -> Array:
        return jax.random.uniform(key, shape, dtype, minval=self.low, maxval=self.high)


def _truncated_normal(key: Key, low: float, high: float, shape: tuple[int, ...], dtype: Any) -> Array:
    """Standard normal numbers between two bounds.

    They are drawn from the lower tail, where the distribution function has full precision. For an interval above the
    mean the sign of bounds and numbers changes.
    """
    above = low + high > 0.0
    low, high = (-high, -low) if above else (low, high)
    first, last = (ndtr(jnp.asarray(bound, dtype)) for bound in (low, high))
    share = jax.random.uniform(key, shape, dtype, minval=0.5 * float(jnp.finfo(dtype).eps))
    drawn = jnp.clip(ndtri(first + (last - first) * share), low, high)
    return -drawn if above else drawn


@dataclasses.dataclass(frozen=True)
class LogUniform(Distribution):
    """The logarithm is uniform from log(low) to log(high), 0 < low < high. The median is sqrt(low * high)."""

    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_range(self, self.low, self.high)
        self._require(self.low > 0.0, "low", self.low, "give a number above 0, or use Uniform")

    def sample(self, key: Key, shape: tuple[int, ...], dtype: Any) -> Array:
        drawn = jax.random.uniform(key, shape, dtype, minval=math.log(self.low), maxval=math.log(self.high))
        return jnp.clip(jnp.exp(drawn), self.low, self.high)  # rounding can lead a little beyond


@dataclasses.dataclass(frozen=True)
class Normal(Distribution):
    """Normal with ``mean`` and standard deviation ``std`` > 0; given ``low`` or ``high``, cut off there.

    Numbers beyond the bounds are drawn again, so the mean moves if the bounds are not symmetric.
    """

    mean: float
    std: float
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(math.isfinite(self.mean), "mean", self.mean, "give a finite number")
        self._require(0.0 < self.std < math.inf, "std", self.std, "give a finite number above 0, or use Constant")
        self._require(self.low < self.high, "low", self.low, f"give a number below high, which is {self.high}")
        furthest = f"give one within {_MAX_STDS:g} std of the mean, {self.mean} with std {self.std}"
        self._require(self._standard(self.low) < _MAX_STDS, "low", self.low, furthest)
        self._require(self._standard(self.high) > -_MAX_STDS, "high", self.high, furthest)

    def sample(self, key: Key, shape: tuple[int, ...], dtype: Any) -> Array:
        if math.isinf(self.low) and math.isinf(self.high):
            return self.mean + self.std * jax.random.normal(key, shape, dtype)
        low, high = self._standard(self.low), self._standard(self.high)
        drawn = self.mean + self.std * _truncated_normal(key, low, high, shape, dtype)
        return jnp.clip(drawn, self.low, self.high)

    def _standard(self, value: float) -> float:
        return (value - self.mean) / self.std


@dataclasses.dataclass(frozen=True)
class LogNormal(Distribution):
    """The logarithm is normal with mean log(median) and standard deviation ``log_std``; given bounds, cut off there.

    A ``log_std`` of 0.1 is an uncertainty of about 10 %.
    """

    median: float
    log_std: float
    low: float = 0.0
    high: float = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(0.0 < self.median < math.inf, "median", self.median, "give a finite number above 0")
        self._require(0.0 < self.log_std < math.inf, "log_std", self.log_std, "give a finite number above 0")
        self._require(0.0 <= self.low < self.high, "low", self.low, f"give one from 0 to below high, {self.high}")
        furthest = f"give one within {_MAX_STDS:g} log_std of the median, {self.median} with log_std {self.log_std}"
        self._require(self._standard(self.low) < _MAX_STDS, "low", self.low, furthest)
        self._require(self._standard(self.high) > -_MAX_STDS, "high", self.high, furthest)

    def sample(self, key: Key, shape: tuple[int, ...], dtype: Any) -> Array:
        low, high = self._standard(self.low), self._standard(self.high)
        if math.isinf(low) and math.isinf(high):
            return self.median * jnp.exp(self.log_std * jax.random.normal(key, shape, dtype))
        drawn = _truncated_normal(key, low, high, shape, dtype)
        return jnp.clip(self.median * jnp.exp(self.log_std * drawn), self.low, self.high)

    def _standard(self, value: float) -> float:
        if value in (0.0, math.inf):
            return math.inf if value else -math.inf
        return math.log(value / self.median) / self.log_std


@dataclasses.dataclass(frozen=True)
class Choice(Distribution):
    """One of ``values``. All are equally likely unless ``weights`` are given: positive numbers, one per value."""

    values: tuple[float, ...]
    weights: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("values", "weights"):
            given = getattr(self, name)
            if name == "weights" and given is None:
                continue
            self._require(np.ndim(given) == 1 and len(given) > 0, name, given, "give a tuple of numbers")
            numbers = tuple(self._number(f"{name}[{i}]", value) for i, value in enumerate(given))
            object.__setattr__(self, name, numbers)
        for i, value in enumerate(self.values):
            self._require(math.isfinite(value), f"values[{i}]", value, "give a finite number")
        if self.weights is not None:
            each = f"give one for each of the {len(self.values)} values"
            self._require(len(self.weights) == len(self.values), "weights", self.weights, each)
            for i, weight in enumerate(self.weights):
                self._require(0.0 < weight < math.inf, f"weights[{i}]", weight, "give a finite number above 0")

    def sample(self, key: Key, shape: tuple[int, ...], dtype: Any) -> Array:
        shares = None if self.weights is None else jnp.asarray(self.weights) / sum(self.weights)
        return jax.random.choice(key, jnp.asarray(self.values, dtype), shape, p=shares)


@dataclasses.dataclass(frozen=True)
class Scale:
    """Multiplies the present value by the drawn number: ``Scale(LogUniform(0.5, 2.0))``.

    Gradient: the derivative of the new value with respect to the present one is the factor.
    """

    by: Distribution

    def __post_init__(self) -> None:
        _check_distribution(self, self.by)


@dataclasses.dataclass(frozen=True)
class Shift:
    """Adds the drawn number to the present value: ``Shift(Normal(0.0, 0.01))``.

    Gradient: the derivative of the new value with respect to the present one is 1.
    """

    by: Distribution

    def __post_init__(self) -> None:
        _check_distribution(self, self.by)


@dataclasses.dataclass(frozen=True)
class Turn:
    """Turns a rotation matrix by a small random rotation: ``Turn(Normal(0.0, 0.02))``.

    Three numbers are drawn [rad]: the rotation vector, about the x, y and z axes of the turned frame. The result is a
    rotation, too.

    Gradient: the derivative of the new matrix with respect to the present one is the product with the random rotation.
    """

    by: Distribution

    def __post_init__(self) -> None:
        _check_distribution(self, self.by)
        if self.by.per is not Per.LEAF:
            raise ValueError(f"Turn.by has {self.by.per}: leave per out, a rotation always gets three numbers")


def _check_range(distribution: Any, low: float, high: float) -> None:
    for name, bound in (("low", low), ("high", high)):
        distribution._require(math.isfinite(bound), name, bound, "give a finite number")
    remedy = f"give a number below high, which is {high}, or use Constant"
    distribution._require(low < high, "low", low, remedy)


def _check_distribution(change: Any, given: Any) -> None:
    if not isinstance(given, Distribution):
        name = type(change).__name__
        raise ValueError(f"{name}.by is {given!r}: give a distribution, as in {name}(Uniform(0.5, 2.0))")


__all__ = [
    "Choice", "Constant", "Distribution", "LogNormal", "LogUniform", "Normal", "Per", "Scale", "Shift", "Turn",
    "Uniform",
]  # fmt: skip
