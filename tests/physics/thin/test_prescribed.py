"""Pins and grips of a step: constant grips count for every substep, other shapes are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import SHEET, cloth_scene

from rewax.physics import thin
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin.prescribed import checked_prescribed


def held_by_a_hand():
    scene = cloth_scene(held=[0, 3], grasps=(thin.Grasp(radius=0.1, stiffness=100.0),) * 2)
    return scene, thin.open_grasps(scene, thin.initial_state(SHEET.vertices), Pose(jnp.zeros((1, 3)), jnp.eye(3)[None]))


def test_constant_grips_count_for_every_substep(x64):
    scene, state = held_by_a_hand()
    pins = np.zeros((5, 2, 3))
    found = checked_prescribed(scene, state, pins, np.array([0.2, 0.7]), 5, 1)
    np.testing.assert_array_equal(found.pins, pins)
    np.testing.assert_array_equal(found.grips, np.tile([0.2, 0.7], (5, 1)))
    each = np.linspace(0.0, 1.0, 10).reshape(5, 2)
    np.testing.assert_array_equal(checked_prescribed(scene, state, None, each, 5, 1).grips, each)


def test_pins_and_grips_take_the_precision_of_the_state(x64):
    scene, state = jax.tree.map(lambda a: a.astype(jnp.float32), held_by_a_hand())
    found = checked_prescribed(scene, state, np.zeros((5, 2, 3)), np.array([0, 1]), 5, 1)
    assert found.pins.dtype == found.grips.dtype == jnp.float32


def test_other_shapes_are_refused(x64):
    scene, state = held_by_a_hand()
    for pins, grips, message in (
        (np.zeros((5, 3, 3)), np.zeros(2), r"pins has shape \(5, 3, 3\), but the scene has 2 held vertices"),
        (None, np.zeros(3), r"grips has shape \(3,\), but the scene has 2 grasps"),
        (None, None, "grips has shape None"),
    ):
        with pytest.raises(ValueError, match=message):
            checked_prescribed(scene, state, pins, grips, 5, 1)
    with pytest.raises(ValueError, match=r"state\.holds has 0 entries"):
        checked_prescribed(scene, state.replace(holds=()), None, np.zeros(2), 5, 1)


def test_pins_may_be_a_list(x64):
    scene = cloth_scene(held=[0, 3])
    state, pins = thin.initial_state(SHEET.vertices), SHEET.vertices[[0, 3]] + np.zeros((5, 2, 3))
    listed, array = (thin.step(scene, state, thin.static_poses(5, dtype=float), pins=p) for p in (pins.tolist(), pins))
    np.testing.assert_array_equal(listed.x, array.x)
