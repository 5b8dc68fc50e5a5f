"""Helpers of the physics tests, as fixtures."""

import jax
import numpy as np
import pytest


@pytest.fixture(scope="module", autouse=True)
def release_programs():
    """Programs of one module are no use to the next, and each keeps memory and many memory maps."""
    yield
    jax.clear_caches()


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
