"""Balls and capsules: against projections onto them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from shape_cases import SHAPES, H, R, assert_nearest


def nearest_on_axis(name, p):
    half = H if name == "capsule" else 0.0
    return np.clip(p, [0, -half, 0], [0, half, 0])


@pytest.mark.parametrize("name", ["sphere", "capsule"])
@given(seed=hs.integers(0, 10_000))
def test_distance_is_the_one_to_the_nearest_point(x64, name, seed):
    def project(p):
        middle = nearest_on_axis(name, p)
        away = p - middle
        return middle + away * np.minimum(1.0, R / np.linalg.norm(away, axis=1))[:, None]

    assert_nearest(SHAPES[name], seed, project, lambda p: R - np.linalg.norm(p - nearest_on_axis(name, p), axis=1))


def test_a_capsule_without_length_is_a_ball(x64):
    ball, capsule = SHAPES["sphere"], SHAPES["capsule"].replace(half_length=0.0)
    np.testing.assert_allclose(capsule.volume(), ball.volume(), rtol=1e-12)
    for a, b in zip(capsule.inertia(3.0), ball.inertia(3.0), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
