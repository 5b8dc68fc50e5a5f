"""Checks that scenes of vertices share: each refusal is one sentence."""

import numpy as np
import pytest

from rewax.physics.contact import Collider
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.contact.vertex_checks import check_dt, contact_numbers, held_indices
from rewax.physics.numerics.checks import any_illegal
from rewax.physics.shapes import Plane


def test_held_vertices_are_indices_or_a_mask():
    np.testing.assert_array_equal(held_indices([2, 0], 3), [2, 0])  # in the order given
    np.testing.assert_array_equal(held_indices([True, False, True], 3), [0, 2])
    np.testing.assert_array_equal(held_indices(1, 3), [1])
    assert held_indices((), 3).shape == (0,)


@pytest.mark.parametrize("held", [[0, 0], [0.5], [[0, 1]], [True, False], [[0], [1, 2]], "all"])
def test_other_arrays_are_refused(held):
    with pytest.raises(ValueError, match=r"^held is an array of .*: give different indices of vertices, or a mask"):
        held_indices(held, 3)


def test_indices_are_in_range():
    with pytest.raises(ValueError, match=r"^held has indices from 0 to 3, but there are 3 vertices"):
        held_indices([0, 3], 3)


def test_friction_of_the_ground_and_of_colliders_needs_a_damping():
    rough, smooth = (Collider(shape=Plane(), friction=friction) for friction in (0.5, 0.0))
    ground = Ground(normal=(0.0, 1.0, 0.0))
    for friction, planes, grounds, illegal in (
        (0.0, (smooth, rough), None, True),
        (0.0, (smooth,), ground, False),
        (0.5, (smooth,), ground, True),
        (0.5, (smooth,), None, False),  # the coefficient of a ground that is not there
    ):
        contact = PenaltyContact(stiffness=1.0, friction=friction)
        assert bool(any_illegal(contact_numbers(contact, grounds, planes))) == illegal
        damped = contact.replace(friction_damping=0.1)
        assert not any_illegal(contact_numbers(damped, grounds, planes))


def test_a_substep_is_at_most_the_largest_stable_one():
    check_dt(1e-3, 1e-3)
    with pytest.raises(ValueError, match=r"^dt is 0.0011 s, above the largest stable 0.001 s .* coarser mesh$"):
        check_dt(1.1e-3, 1e-3)
