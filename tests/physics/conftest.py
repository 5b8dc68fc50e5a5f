"""Helpers of the physics tests, as fixtures."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rigid_models import QUICK_TO_COMPILE


@pytest.fixture(scope="module", autouse=True)
def release_programs():
    """Programs of one module are no use to the next, and each keeps memory and many memory maps."""
    yield
    jax.clear_caches()


def _norm(tree) -> float:
    return float(np.sqrt(sum(np.sum(np.square(np.asarray(leaf, np.float64))) for leaf in jax.tree.leaves(tree))))


@pytest.fixture(scope="session")
def relative_error():
    """``relative_error(a, b)``: |a - b| / |b| over all leaves of two trees."""

    def error(a, b) -> float:
        difference = jax.tree.map(lambda x, y: np.asarray(x, np.float64) - np.asarray(y, np.float64), a, b)
        return _norm(difference) / max(_norm(b), 1e-300)

    return error


@pytest.fixture(scope="session")
def random_like():
    """``random_like(seed, tree)``: a tree of standard normal numbers of the same shapes and dtypes."""

    def make(seed: int, tree):
        rng = np.random.default_rng(seed)
        return jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(jnp.shape(a)), jnp.result_type(a)), tree)

    return make


@pytest.fixture(scope="session")
def central_difference():
    """``central_difference(f, x, dx, step)``: (f(x + step dx) - f(x - step dx)) / (2 step), of trees."""

    def difference(f, x, dx, step: float = 1e-6):
        ahead = f(jax.tree.map(lambda a, d: a + step * d, x, dx))
        behind = f(jax.tree.map(lambda a, d: a - step * d, x, dx))
        return jax.tree.map(lambda a, b: (a - b) / (2.0 * step), ahead, behind)

    return difference


@pytest.fixture(scope="session")
def rotations():
    """``rotations(seed, num)``: random rotation matrices, float64, shape (num, 3, 3)."""

    def make(seed: int, num: int) -> np.ndarray:
        q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((num, 3, 3)))
        q = q * np.sign(np.diagonal(r, axis1=-2, axis2=-1))[:, None, :]
        return q * np.sign(np.linalg.det(q))[:, None, None]

    return make


@pytest.fixture(scope="session")
def stretched(rotations):
    """``stretched(seed, singular_values)``: U diag(s) V^T with random rotations, one for each row of s."""

    def make(seed: int, singular_values) -> np.ndarray:
        s = np.asarray(singular_values, np.float64)
        u, v = rotations(seed, len(s)), rotations(seed + 1, len(s))
        return np.einsum("nij,nj,nkj->nik", u, s, v)

    return make


@pytest.fixture(scope="session")
def inner():
    """``inner(a, b)``: the scalar product of two trees of one structure."""

    def product(a, b) -> float:
        return sum(float(jnp.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))

    return product


@pytest.fixture(scope="session")
def derivatives():
    """``derivatives(f)(x, dx, weights)``: f(x), its forward derivative along dx, its reverse derivative of weights.

    One compiled program; ``weights`` is a function of f(x) that is called while tracing. Further arguments of
    ``derivatives`` are ``jax.jit``'s. It is compiled quickly rather than well.
    """

    def of(f, **options):
        @functools.partial(jax.jit, static_argnames="weights", **{"compiler_options": QUICK_TO_COMPILE, **options})
        def all_three(x, dx, weights):
            value, forward = jax.linearize(f, x)
            chosen = weights(value)
            return value, forward(dx), chosen, jax.linear_transpose(forward, x)(chosen)[0]

        return all_three

    return of
