"""What self-contact refuses when a scene is built, and which numbers are illegal later."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from self_contact_bodies import FORCE, law
from thin_bodies import LINE, SHEET, cloth_scene, rope_scene

from rewax.physics import thin
from rewax.status import Status

STATUS = jax.jit(thin.check_status)
REFUSED = [
    ({"thickness": -1.0}, "self_contact.thickness is -1.0"),
    ({"thickness": 0.06}, "more than half of the smallest height"),
    ({"max_speed": 100.0}, "self_contact.max_speed is 100"),
    ({"stiffness": 1e7}, "above the largest stable"),
    ({"friction_damping": 0.0}, "self_contact.friction_damping with friction is 0.0, but must be positive"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_illegal_self_contact_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        cloth_scene(SHEET, self_contact=law(**changes))


@pytest.mark.parametrize(
    ("make", "mesh", "name", "built", "legal", "illegal"),
    [
        (cloth_scene, SHEET, "thickness", 0.01, 0.02, 0.05),  # half of a triangle's height is 0.035
        (rope_scene, LINE, "rope_thickness", 0.02, 0.06, 0.12),
    ],
)
def test_a_thickness_that_needs_more_neighbours_is_illegal(x64, make, mesh, name, built, legal, illegal):
    """Neighbours are those of the thickness at building: beyond it, a mesh at rest would repel itself."""
    scene = make(mesh, self_contact=law(thickness=built, max_speed=0.1))
    state = thin.initial_state(mesh.vertices)

    def changed(thickness):
        return scene.replace(self_contact=scene.self_contact.replace(**{name: thickness}))

    assert STATUS(changed(legal), state) == Status.OK
    assert float(jnp.abs(FORCE(changed(legal), state)).max()) == 0.0
    assert STATUS(changed(illegal), state) & Status.INVALID_PARAMETERS
    half = dataclasses.replace(mesh, vertices=0.5 * np.asarray(mesh.vertices))
    smaller = make(half, self_contact=law(thickness=0.5 * built, max_speed=0.05))
    assert jax.tree.structure(smaller) == jax.tree.structure(scene)  # so they can be stacked
    assert STATUS(scene.replace(rest=smaller.rest, self_contact=changed(legal).self_contact), state) & (
        Status.INVALID_PARAMETERS
    )


def test_a_friction_that_begins_later_needs_its_damping():
    scene = cloth_scene(SHEET, self_contact=law(friction=0.0, friction_damping=0.0))
    state = thin.initial_state(SHEET.vertices)
    assert STATUS(scene, state) == Status.OK
    rough = scene.replace(self_contact=scene.self_contact.replace(friction=0.3))
    assert STATUS(rough, state) == Status.INVALID_PARAMETERS
