"""The bowl: its distance is exact, its drawing lies on its surface, and grains stay in it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.kit.bowl import Bowl
from rewax.physics.shapes import signed_distance, volume
from rewax.testing import check_shape

BOWL = Bowl(radius=0.13, thickness=0.025)


def test_it_is_a_shape():
    check_shape(BOWL, notify=None)


def test_the_distance_is_that_of_the_nearest_point_of_a_hemisphere():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (200, 3))
    polar, around = np.meshgrid(np.linspace(-np.pi / 2, 0.0, 400), np.linspace(0.0, 2 * np.pi, 400))
    arc = np.stack([np.cos(polar) * np.cos(around), np.sin(polar), np.cos(polar) * np.sin(around)], axis=-1)
    arc = 0.13 * arc.reshape(-1, 3)
    wanted = [np.linalg.norm(arc - p, axis=1).min() - 0.0125 for p in points]
    np.testing.assert_allclose(signed_distance(BOWL, jnp.asarray(points))[0], wanted, atol=5e-4)


def test_the_volume_is_that_of_a_shell_and_a_half_round_rim():
    outer, inner, half = 0.1425, 0.1175, 0.0125
    shell = 2.0 / 3.0 * np.pi * (outer**3 - inner**3)
    rim = 0.5 * np.pi * half**2 * 2.0 * np.pi * 0.13  # Pappus, and its centroid is above the circle of the rim
    assert float(volume(BOWL)) == pytest.approx(shell + rim, rel=5e-3)


def test_the_drawing_lies_on_the_surface_and_is_absent_for_traced_sizes():
    (drawing,) = BOWL.draw()
    x = drawing["vertices"]
    np.testing.assert_allclose(signed_distance(BOWL, jnp.asarray(x))[0], 0.0, atol=1e-6)
    a, b, c = (x[corner] for corner in drawing["triangles"].T)
    enclosed = np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0  # positive if seen counter-clockwise from outside
    assert enclosed == pytest.approx(float(volume(BOWL)), rel=0.05)
    jax.jit(lambda r: [Bowl(radius=r, thickness=0.01).draw()] and r)(0.1)
