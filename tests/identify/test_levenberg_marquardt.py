"""The search on functions whose minimum is known: bounds, failures, instability."""

import numpy as np
import pytest

from rewax.identify import levenberg_marquardt as lm
from rewax.identify.evaluation import Evaluation

TARGET = np.array([0.7, -0.4])


def rosenbrock(points, fails=lambda p: False):
    """Residuals (10 (y - x^2), 1 - x) about a minimum at (0.7, 0.49)."""
    x, y = points.T
    r = np.stack([10.0 * (y - x**2), 0.7 - x], -1)
    jacobian = np.stack([np.stack([-20.0 * x, np.full_like(x, 10.0)], -1), np.stack([-np.ones_like(x), 0 * x], -1)], 1)
    gradient = np.einsum("sr,srk->sk", r, jacobian)
    ok = np.array([not fails(p) for p in points])
    return Evaluation(
        cost=0.5 * (r**2).sum(-1), gradient=gradient, hessian=np.einsum("sri,srj->sij", jacobian, jacobian),
        scores=gradient[:, None], spread=np.ones(len(points)), by_frame=np.zeros((len(points), 1)),
        status=np.where(ok, 0, 64), ok=ok,
    )  # fmt: skip


def search(points, evaluate=rosenbrock, *, bounds=(-3.0, 3.0), is_stable=lambda p: True, precision=0.0, iterations=60):
    points = np.asarray(points, float)
    low, high = (np.broadcast_to(np.asarray(b, float), 2) for b in bounds)
    starts = lm.begin(points, evaluate(points))
    for _ in range(iterations):
        starts = lm.iterate(
            starts,
            lambda p, needed: evaluate(p),
            precision=np.full(2, precision),
            bounds=(low, high),
            is_stable=is_stable,
        )
        if not starts.active.any():
            break
    return starts


def test_all_starts_reach_the_minimum_and_stop():
    found = search([[-1.2, 1.0], [2.0, 2.0], [0.0, 0.0]])
    np.testing.assert_allclose(found.latents, np.tile([0.7, 0.49], (3, 1)), atol=5e-3)
    assert not found.active.any() and not found.rejected.any()


def test_a_bound_is_reached_and_kept():
    found = search([[-1.2, 1.0]], bounds=((-3.0, -3.0), (0.4, 3.0)))
    np.testing.assert_allclose(found.latents[0], [0.4, 0.16], atol=5e-3)


def test_failures_are_rejected_counted_and_never_accepted():
    found = search([[-0.5, 0.3]], lambda p: rosenbrock(p, lambda q: q[0] > 0.3))
    assert found.latents[0, 0] <= 0.3 and found.rejected[0] > 0 and found.evaluation.ok[0]
    lost = search([[2.0, 2.0]], lambda p: rosenbrock(p, lambda q: q[0] > 0.9))  # begins where simulations fail
    np.testing.assert_allclose(lost.latents[0], [0.7, 0.49], atol=5e-3)


def test_what_is_known_to_be_unstable_is_never_tried():
    tried = []

    def evaluate(points):
        tried.append(points.copy())
        return rosenbrock(points)

    search([[-0.5, 0.3]], evaluate, is_stable=lambda p: p[0] < 0.3)
    assert max(float(points[:, 0].max()) for points in tried) < 0.3


def test_the_prior_pulls():
    free, held = search([[0.1, 0.1]]), search([[0.1, 0.1]], precision=3.0)
    assert np.linalg.norm(held.latents[0]) < 0.7 * np.linalg.norm(free.latents[0])
    total = held.total(np.full(2, 3.0))
    assert total[0] == pytest.approx(held.evaluation.cost[0] + 1.5 * (held.latents[0] ** 2).sum())
