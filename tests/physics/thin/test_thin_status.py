"""Status bits of cloth and ropes."""

import jax.numpy as jnp
import pytest
from thin_bodies import LINE, SHEET, cloth_scene, rope_scene

from rewax.physics import thin
from rewax.physics.contact import PenaltyContact
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


def test_a_force_that_began_to_jump_is_illegal_for_implicit_steps_alone(x64):
    state, contact = thin.initial_state(SHEET.vertices), PenaltyContact(stiffness=50.0, depth_damping=1.0)
    for stepper, status in ((thin.Implicit(), Status.INVALID_PARAMETERS), (None, Status.OK)):
        scene = cloth_scene(stepper=stepper, contact=contact)
        assert thin.check_status(scene, state) == 0
        jumping = scene.replace(contact=contact.replace(damping=jnp.asarray(0.1)))
        assert thin.check_status(jumping, state) == status
        assert thin.check_status(jumping.replace(contact=jumping.contact.replace(onset=0.01)), state) == 0


def test_a_neo_hookean_material_that_became_anisotropic_is_illegal(x64):
    scene, state = cloth_scene(law=thin.MembraneLaw.NEO_HOOKEAN), thin.initial_state(SHEET.vertices)
    assert thin.check_status(scene, state) == 0
    softer = scene.replace(cloth=scene.cloth.replace(weft=0.9 * scene.cloth.weft))
    assert thin.check_status(softer, state) == Status.INVALID_PARAMETERS


def test_a_state_of_another_mesh_is_refused(x64):
    """Its arrays would be read beyond their ends."""
    scene, poses = rope_scene(), thin.static_poses(1, dtype=float)
    short = thin.initial_state(LINE.vertices[:5])
    message = r"state.x has shape \(5, 3\), but the scene has 9 vertices"
    for call in (thin.check_status, thin.elastic_energy, thin.internal_force, thin.self_contact_force):
        with pytest.raises(ValueError, match=message):
            call(scene, short)
    with pytest.raises(ValueError, match=message):
        thin.step(scene, short, poses)
    with pytest.raises(ValueError, match=r"state.v has shape \(1, 3\)"):
        thin.step(scene, thin.initial_state(LINE.vertices).replace(v=jnp.zeros((1, 3))), poses)
