"""Bending of plates against Kirchhoff's theory, on regular, one-sided and irregular meshes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import NOTHING

from rewax.physics import thin

RIGIDITY, DENSITY = 1e-2, 0.3
HELD = {"held": (), "gravity": NOTHING, "dt": 1e-7}


def alternating(size, width, n, m):
    return thin.sheet(size, width, n, m)


def one_sided(size, width, n, m):
    """All diagonals point the same way."""
    cell = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    a, b, c, d = (part.reshape(-1) for part in (cell[:-1, :-1], cell[:-1, 1:], cell[1:, 1:], cell[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    return thin.ThinMesh(vertices=thin.sheet(size, width, n, m).vertices, triangles=triangles.astype(np.int32))


def irregular(size, width, n, m):
    """Vertices moved by up to a quarter of a cell, but along no axis within the rows that may be held."""
    mesh = thin.sheet(size, width, n, m)
    x = np.array(mesh.vertices)
    for axis, end, count in ((0, size, n), (2, width, m)):
        cell, margin = end / count, (1.2 if count > 4 else 0.2) * end / count
        inner = (x[:, axis] > margin) & (x[:, axis] < end - margin)
        x[inner, axis] += 0.25 * cell * np.random.default_rng(axis).uniform(-1, 1, inner.sum())
    return thin.ThinMesh(vertices=x, triangles=mesh.triangles)


MESHES = (alternating, one_sided, irregular)


def plate(mesh, ratio=0.3, **changes):
    cloth = thin.Cloth(warp=1e3, weft=1e3, shear=500.0, bending=RIGIDITY, bending_ratio=ratio, density=DENSITY)
    return thin.make_scene(**(HELD | {"mesh": mesh, "cloth": cloth} | changes))


@jax.jit
def stiffness(scene, x):
    """Second derivative of the energy of a flat sheet with respect to the heights of vertices."""

    def lifted(y):
        return -thin.internal_force(scene, thin.initial_state(x.at[:, 1].set(y)))[:, 1]

    return jax.jacfwd(lifted)(x[:, 1])


def sag(scene, mesh, held):
    """Deflection of vertices under a load of mass times 1 m/s^2, by linear theory."""
    free = np.flatnonzero(~held)
    K = np.asarray(stiffness(scene, jnp.asarray(mesh.vertices)))[np.ix_(free, free)]
    moved = np.zeros(len(held))
    moved[free] = np.linalg.solve(K, np.asarray(scene.mass)[free])
    return moved


def rim(mesh, depth):
    """Vertices of a unit square nearer to its rim than ``depth``, in the numbering of ``thin.sheet``."""
    return np.any((mesh[:, [0, 2]] < depth) | (mesh[:, [0, 2]] > 1 - depth), axis=1)


def center_error(make, n, ratio, clamped):
    mesh, regular = make(1.0, 1.0, n, n), thin.sheet(1.0, 1.0, n, n).vertices
    moved = sag(plate(mesh, ratio), mesh, rim(regular, (1.5 if clamped else 0.5) / n))
    # A clamped plate ends in the middle of its held cells. Timoshenko and Woinowsky-Krieger, tables 8 and 35.
    exact = 0.00126532 * (1 - 1 / n) ** 4 if clamped else 0.00406235
    return moved[len(moved) // 2] / (exact * DENSITY / RIGIDITY) - 1


@pytest.mark.parametrize("make", MESHES)
def test_constant_curvature_needs_no_force_inside(x64, make):
    """The patch test: the energy per area is the plate's, and inner vertices are in equilibrium."""
    mesh = make(1.0, 1.0, 12, 12)
    x = np.asarray(mesh.vertices)
    inside = np.abs(x[:, [0, 2]] - 0.5).max(axis=1) < 0.2
    K = np.asarray(stiffness(plate(mesh), jnp.asarray(x)))
    for w in (0.5 * x[:, 0] ** 2, 0.5 * x[:, 2] ** 2, x[:, 0] * x[:, 2]):
        force = K @ w
        assert np.abs(force[inside]).max() < 1e-9 * np.abs(force).max()


@pytest.mark.parametrize("make", MESHES)
@pytest.mark.parametrize("clamped", [False, True])
def test_square_plates_sag_as_theory_says_on_every_mesh(x64, make, clamped):
    errors = [center_error(make, n, 0.3, clamped) for n in (8, 16)]
    name = "clamped" if clamped else "supported"
    print(f"{name} square, {make.__name__}, 8 and 16 cells: {', '.join(f'{e:.1e}' for e in errors)}")
    assert abs(errors[1]) < 0.015
    if make is not irregular:
        assert errors[0] / errors[1] > 3.0


def test_poissons_ratio_leaves_a_supported_square_and_softens_a_free_strip(x64):
    """A straight supported rim hides the ratio. A strip bends sideways too: D (1 - ratio^2) in place of D."""
    errors = [center_error(alternating, 16, ratio, False) for ratio in (-0.2, 0.0, 0.4)]
    assert np.ptp(errors) < 0.01, errors  # of second order in the cells, as the error itself
    tips = [strip_tip(alternating, 20, 2, ratio) for ratio in (0.0, 0.3)]
    np.testing.assert_allclose(tips[1] / tips[0], 1 / (1 - 0.3**2), rtol=0.015)


def strip_tip(make, n, m, ratio, **changes):
    """Deflection of the free end of a strip of 1 m by 0.1 m, over that of a beam with width times ``RIGIDITY``."""
    mesh = make(1.0, 0.1, n, m)
    scene = plate(mesh, ratio, **changes)
    held = np.arange(len(mesh.vertices)) < 2 * (m + 1)
    return sag(scene, mesh, held)[-(m + 1) :].mean() / (DENSITY * (1 - 0.5 / n) ** 4 / (8 * RIGIDITY))


@pytest.mark.parametrize("make", MESHES)
def test_a_strip_with_free_sides_bends_as_a_beam(x64, make):
    error = strip_tip(make, 40, 4, 0.0) - 1
    print(f"free strip, {make.__name__}, of 4 cells: {error:.1e}")
    assert abs(error) < (0.01 if make is irregular else 1e-3)


def test_hinges_alone_are_a_fifth_too_soft(x64):
    """A limit of one spring per edge, at any refinement: the strip bends between its diagonals too."""
    for m in (1, 2):
        error = strip_tip(alternating, 10 * m, m, 0.0, bending_law=thin.BendingLaw.HINGES) - 1
        print(f"free strip of hinges, {10 * m} x {m} cells: {error:.3f} too soft")
        assert 0.15 < error < 0.25
