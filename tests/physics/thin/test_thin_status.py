"""Status bits of cloth and ropes."""

import jax.numpy as jnp
from thin_bodies import SHEET, cloth_scene

from rewax.physics import thin
from rewax.status import Status


def test_status_names_what_is_wrong(x64):
    scene, state = cloth_scene(), thin.initial_state(SHEET.vertices)
    assert thin.check_status(scene, state) == 0
    assert thin.check_status(scene, state.replace(v=state.v.at[0, 0].set(jnp.nan))) == Status.NAN
    assert thin.check_status(scene, state.replace(x=state.x * jnp.array([1.0, 1.0, 1e-5]))) == Status.INVERTED
    bad = scene.replace(cloth=scene.cloth.replace(warp=-1.0))
    assert thin.check_status(bad, state) & Status.INVALID_PARAMETERS
    assert thin.check_status(scene.replace(dt=1.0), state) == Status.INVALID_PARAMETERS


def test_a_missed_tolerance_counts_for_implicit_steps_alone(x64):
    state = thin.initial_state(SHEET.vertices).replace(error=jnp.asarray(2e-3))
    assert thin.check_status(cloth_scene(stepper=thin.Implicit(tolerance=1e-3)), state) == Status.UNSOLVED
    assert thin.check_status(cloth_scene(stepper=thin.Implicit(tolerance=3e-3)), state) == 0
    assert thin.check_status(cloth_scene(), state) == 0
