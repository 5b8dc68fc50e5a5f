"""Functions of eigenvalues together with their divided differences, without cancellation.

The derivative of an isotropic tensor function needs (f_i - f_j) / (lambda_i - lambda_j) for each pair of eigenvalues
(``linalg3.spectral``). This quotient loses digits as eigenvalues meet: in float32 it loses all of them at a gap of
1e-7, the gap of dough at rest. The limit for small gaps does not help: a return map's slope varies over strains as
small as its yield strain. So divided differences are propagated through the function like derivatives: each operation
here takes and returns values and divided differences, by a chain rule that is exact for any gap. With f[a, b] the
divided difference of f at a and b:
(f o g)[a, b] = f[g(a), g(b)] g[a, b], and (f g)[a, b] = (f(a) + f(b)) / 2 g[a, b] + f[a, b] (g(a) + g(b)) / 2.

A quantity that depends on all eigenvalues (a trace, a norm, a yield condition) is one array, the same on all axes.

Gradient: exact for values. Divided differences serve derivatives and have no derivative of their own.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from rewax.lowering.structural import structural_zeros
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.types import Array, Scalar

PAIRS = ((1, 2), (0, 2), (0, 1))


@dataclasses.dataclass(frozen=True)
class Principal:
    """The same function of each eigenvalue. ``+ - * /`` and unary ``-`` act elementwise, also with a scalar."""

    values: Vec3
    differences: Vec3 | None = None
    """Divided differences by eigenvalues: entry k belongs to the axes other than k (``PAIRS``). None: not computed."""

    def __add__(self, other: "Principal | Scalar") -> "Principal":
        return add(self, other) if isinstance(other, Principal) else shift(self, other)

    def __sub__(self, other: "Principal | Scalar") -> "Principal":
        return add(self, scale(-1.0, other)) if isinstance(other, Principal) else shift(self, -other)

    def __rsub__(self, other: Scalar) -> "Principal":
        return shift(scale(-1.0, self), other)

    def __mul__(self, other: "Principal | Scalar") -> "Principal":
        return multiply(self, other) if isinstance(other, Principal) else scale(other, self)

    def __truediv__(self, other: "Principal | Scalar") -> "Principal":
        return multiply(self, reciprocal(other)) if isinstance(other, Principal) else scale(1.0 / other, self)

    def __rtruediv__(self, other: Scalar) -> "Principal":
        return scale(other, reciprocal(self))

    def __neg__(self) -> "Principal":
        return scale(-1.0, self)

    __radd__, __rmul__ = __add__, __mul__
    __array_ufunc__ = None  # NumPy scalars then defer operators to this class

    @property
    def sum(self) -> Array:
        return self.values[0] + self.values[1] + self.values[2]

    @property
    def product(self) -> Array:
        return self.values[0] * self.values[1] * self.values[2]


jax.tree_util.register_dataclass(Principal, data_fields=["values", "differences"], meta_fields=[])


def eigenvalues(values: Vec3) -> Principal:
    """The identity: eigenvalues with divided differences of one."""
    return Principal(values, cp.vector(lambda k: jnp.ones_like(values[k])))


def uniform(a: Array, like: Principal) -> Principal:
    """The same number on all axes."""
    zeros = None if like.differences is None else structural_zeros(cp.vector(lambda k: jnp.zeros_like(a)))
    return Principal((a, a, a), zeros)


def chain(p: Principal, values: Vec3, difference: Callable[[int, int], Array]) -> Principal:
    """f(p), from the values of f and from ``difference(i, j)``, f's divided difference at p's axes i and j."""
    if p.differences is None:
        return Principal(values)
    inner = p.differences
    return Principal(values, cp.vector(lambda k: difference(*PAIRS[k]) * inner[k]))


def add(p: Principal, q: Principal) -> Principal:
    """p + q."""
    both = None if p.differences is None or q.differences is None else cp.add(p.differences, q.differences)
    return Principal(cp.add(p.values, q.values), both)


def scale(a: Scalar, p: Principal) -> Principal:
    """a p, for a number or an array a."""
    return Principal(cp.scale(a, p.values), None if p.differences is None else cp.scale(a, p.differences))


def shift(p: Principal, a: Scalar) -> Principal:
    """p + a."""
    return dataclasses.replace(p, values=cp.vector(lambda i: p.values[i] + a))


def multiply(p: Principal, q: Principal) -> Principal:
    """p q, value by value."""
    a, b = p.values, q.values
    values = cp.vector(lambda i: a[i] * b[i])
    if p.differences is None or q.differences is None:
        return Principal(values)
    da, db = p.differences, q.differences

    def difference(i: int, j: int, k: int) -> Array:
        return 0.5 * ((a[i] + a[j]) * db[k] + (b[i] + b[j]) * da[k])

    return Principal(values, cp.vector(lambda k: difference(*PAIRS[k], k)))  # pyright: ignore[reportCallIssue]


def reciprocal(p: Principal) -> Principal:
    """1 / p, for p without zeros."""
    values = cp.vector(lambda i: 1.0 / p.values[i])
    return chain(p, values, lambda i, j: -values[i] * values[j])


def select(which: Array, p: Principal, q: Principal) -> Principal:
    """p where ``which`` is true, else q."""
    both = jax.tree.map(lambda a, b: jnp.where(which, a, b), (p.values, p.differences), (q.values, q.differences))
    return Principal(*both)


def maximum(p: Principal, least: Scalar) -> Principal:
    """The larger of each value and ``least``. Gradient: exact; of equal ones that of p."""
    values = cp.vector(lambda i: jnp.where(p.values[i] < least, least, p.values[i]))
    return chain(p, values, lambda i, j: _slope(p.values, values, i, j))


def minimum(p: Principal, most: Scalar) -> Principal:
    """The smaller of each value and ``most``. Gradient: exact; of equal ones that of p."""
    values = cp.vector(lambda i: jnp.where(p.values[i] > most, most, p.values[i]))
    return chain(p, values, lambda i, j: _slope(p.values, values, i, j))


def sqrt(p: Principal) -> Principal:
    """Square root of positive values."""
    values = cp.vector(lambda i: jnp.sqrt(p.values[i]))
    return chain(p, values, lambda i, j: 1.0 / (values[i] + values[j]))


def log(p: Principal) -> Principal:
    """Logarithm of positive values."""
    values = cp.vector(lambda i: jnp.log(p.values[i]))

    def difference(i: int, j: int) -> Array:
        rise, run = _log_rise(p.values, values, i, j)
        return rise / run

    return chain(p, values, difference)


def exp(p: Principal) -> Principal:
    """Exponential function."""
    values = cp.vector(lambda i: jnp.exp(p.values[i]))

    def difference(i: int, j: int) -> Array:
        run, rise = _log_rise(values, p.values, i, j)
        return rise / run

    return chain(p, values, difference)


def expm1(p: Principal) -> Principal:
    """exp(p) - 1, accurate for small values."""
    return dataclasses.replace(exp(p), values=cp.vector(lambda i: exp_minus_one(p.values[i])))


@jax.custom_jvp
def exp_minus_one(x: Array) -> Array:
    """exp(x) - 1 up to a few rounding errors; small x use a series. The vectorised C++ has ``exp`` but no ``expm1``.

    Gradient: exact.
    """
    series = jnp.ones_like(x)
    for n in range(_of_precision(x, 7, 11), 1, -1):
        series = 1.0 + series * x * (1.0 / n)
    return jnp.where(jnp.abs(x) < 0.2, x * series, jnp.exp(x) - 1.0)


@exp_minus_one.defjvp
def _exp_minus_one_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    return exp_minus_one(x), jnp.exp(x) * dx


def _log_rise(x: Vec3, log_x: Vec3, i: int, j: int) -> tuple[Array, Array]:
    """log x_i - log x_j and x_i - x_j. For x_i near x_j both are divided by z / 2.

    Source: log(x_i / x_j) = 2 artanh z with z = (x_i - x_j) / (x_i + x_j), whose series is in z^2.
    """
    gap, total = x[i] - x[j], x[i] + x[j]
    near = jnp.abs(gap) < 0.1 * total
    z = gap / total
    square = z * z
    last = _of_precision(z, 7, 15)
    series = jnp.full_like(z, 2.0 / last)
    for n in range(last - 2, 0, -2):
        series = 2.0 / n + series * square
    return jnp.where(near, series, log_x[i] - log_x[j]), jnp.where(near, total, gap)


def _of_precision(x: Array, single: int, double: int) -> int:
    """Number of series terms that the precision of x resolves."""
    return single if jnp.finfo(x.dtype).bits <= 32 else double


def _slope(x: Vec3, y: Vec3, i: int, j: int) -> Array:
    """(y_i - y_j) / (x_i - x_j) for y = clip(x). For equal x: 1 if unclipped, else 0."""
    equal = x[i] == x[j]
    kept = jnp.where(x[i] == y[i], 1.0, 0.0)
    return jnp.where(equal, kept, (y[i] - y[j]) * inverse_gap(x, i, j))


def inverse_gap(x: Vec3, i: int, j: int) -> Array:
    """1 / (x_i - x_j); 1 for equal values. One shared expression, so that XLA computes it once."""
    gap = x[i] - x[j]
    return 1.0 / jnp.where(gap == 0.0, 1.0, gap)
