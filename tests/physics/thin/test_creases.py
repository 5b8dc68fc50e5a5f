"""Creases: elastic below the yield angle, plastic beyond, with derivatives on both sides."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import SHEET, STEP, cloth_scene, shaken

from rewax.physics import thin
from rewax.physics.numerics import components as cp
from rewax.physics.thin import creases, elements
from rewax.physics.thin.stencils import corners
from rewax.status import Status

POINTS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.1, 0.0, 0.05], [-0.1, 0.0, 0.05]])
PAIR = thin.ThinMesh(vertices=POINTS, triangles=np.asarray([[0, 1, 2], [1, 0, 3]], np.int32))
YIELD = 0.5
IMPLICIT = thin.Implicit(tolerance=1e-11, cg_tolerance=1e-4, gradient_tolerance=1e-12)


def folding(**changes):
    """Two triangles at an edge, all but one corner held; the hinge yields at 0.5 rad."""
    cloth = thin.isotropic_cloth(youngs_modulus=1e5, poissons_ratio=0.0, thickness=5e-3, density=300.0, damping=2e-3)
    cloth = cloth.replace(yield_curvature=YIELD / 0.1)
    given = {"mesh": PAIR, "dt": 1e-4, "cloth": cloth, "gravity": (0.0, 0.0, 0.0), "held": [0, 1, 2], "drag": 13.0}
    return thin.make_scene(**given | changes)


def turned(angle):
    """The free corner turned up about the edge."""
    x = POINTS.copy()
    x[3] = [-0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.05]
    return x


def angle_of(scene, state):
    return float(elements.hinge_angle(corners(scene.topology.hinges, cp.split_vector(state.x)))[0])


def test_the_yield_angle_is_the_yield_curvature_times_the_width_of_a_hinge(x64):
    np.testing.assert_allclose(creases.yield_angle(folding()), [YIELD])
    cells = thin.sheet(0.4, 0.3, 4, 3)
    scene = cloth_scene(cells)
    scene = scene.replace(cloth=scene.cloth.replace(yield_curvature=3.0))
    at = scene.topology.hinges.indices
    across = np.ptp(cells.vertices[at[:, :2]][:, :, 0], axis=1) == 0  # lines of the sheet, 0.1 m apart
    np.testing.assert_allclose(np.asarray(creases.yield_angle(scene))[across], 0.3, rtol=1e-6)


@pytest.mark.parametrize("stepper", [None, thin.Implicit(tolerance=1e-6)])
@pytest.mark.parametrize("folded", [0.4, 1.2, -2.5])
def test_a_released_fold_keeps_its_angle_minus_the_yield_angle(x64, folded, stepper):
    scene = folding(stepper=stepper, dt=1e-4 if stepper is None else 2e-3)
    flat = angle_of(scene, thin.initial_state(turned(0.1)))
    state = thin.no_creases(scene, thin.initial_state(turned(folded * np.sign(flat))))
    for _ in range(20 if stepper is None else 5):
        state = STEP(scene, state, thin.static_poses(1000 if stepper is None else 200, dtype=float))
    kept = np.sign(folded) * max(abs(folded) - YIELD, 0.0)
    assert float(jnp.abs(state.v).max()) < 1e-4
    if stepper is None:
        np.testing.assert_allclose(state.crease, [kept], atol=1e-12)
        np.testing.assert_allclose(angle_of(scene, state), kept, atol=1e-3)
    else:  # it creases at the end of the first step, in which the fold opens a little
        np.testing.assert_allclose(state.crease, [kept], atol=0.02)
        np.testing.assert_allclose(angle_of(scene, state), state.crease[0], atol=1e-3)
    assert thin.check_status(scene, state) == 0


def test_below_the_yield_angle_bits_are_those_of_elastic_cloth(x64):
    plain = cloth_scene(damping=1e-4)
    yields = plain.replace(cloth=plain.cloth.replace(yield_curvature=1e3))
    start = shaken(SHEET, size=0.005)
    poses = thin.static_poses(50, dtype=float)
    elastic, plastic = (
        STEP(plain, start, poses),
        STEP(yields, thin.no_creases(yields, start), poses),
    )
    np.testing.assert_array_equal(plastic.crease, 0.0)
    np.testing.assert_array_equal(plastic.x, elastic.x)
    np.testing.assert_array_equal(plastic.v, elastic.v)


@pytest.mark.parametrize(
    ("law", "stepper"),
    [(thin.BendingLaw.PLATE, None), (thin.BendingLaw.HINGES, None), (thin.BendingLaw.PLATE, IMPLICIT)],
)
def test_reverse_is_forward_is_finite_difference_on_both_sides(x64, agree_along, law, stepper):
    scene = cloth_scene(damping=1e-4, bending_law=law, stepper=stepper)
    scene = scene.replace(cloth=scene.cloth.replace(yield_curvature=2.0))
    start = shaken(SHEET, size=0.01)
    state = thin.no_creases(scene, start)
    poses = thin.static_poses(6, dtype=float)

    def measured(scene, state):
        end = thin.step(scene, state, poses, store_every=3)
        return jnp.sum(jnp.cos(jnp.arange(end.x.size)).reshape(end.x.shape) * (end.x + 0.1 * end.v)) + jnp.sum(
            jnp.sin(jnp.arange(end.crease.size)) * end.crease
        )

    ends = STEP(scene, state, poses)
    assert 0 < int((ends.crease != 0).sum()) < ends.crease.size  # some hinges yield
    rng = np.random.default_rng(3)
    zero = jax.tree.map(jnp.zeros_like, (scene, state))
    noise = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), state)
    directions = {
        "state and crease": (zero[0], noise),
        "yield curvature": (zero[0].replace(cloth=zero[0].cloth.replace(yield_curvature=jnp.ones(()))), zero[1]),
    }
    agree_along(measured, (scene, state), directions, step=1e-7, exact=1e-8, bar=1e-4)


def test_a_state_must_have_creases_exactly_if_the_cloth_yields(x64):
    scene, poses = folding(), thin.static_poses(1, dtype=float)
    with pytest.raises(ValueError, match="crease is None, but the cloth yields"):
        thin.step(scene, thin.initial_state(POINTS), poses)
    with pytest.raises(ValueError, match="crease is given"):
        thin.step(
            scene.replace(cloth=scene.cloth.replace(yield_curvature=None)),
            thin.no_creases(scene, thin.initial_state(POINTS)),
            poses,
        )
    bad = scene.replace(cloth=scene.cloth.replace(yield_curvature=-1.0))
    assert thin.check_status(bad, thin.no_creases(scene, thin.initial_state(POINTS))) & Status.INVALID_PARAMETERS
