"""Checks that scenes of vertices share: each refusal is one sentence."""

import numpy as np
import pytest

from rewax.physics.contact.vertex_checks import check_dt, held_indices


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


def test_a_substep_is_at_most_the_largest_stable_one():
    check_dt(1e-3, 1e-3)
    with pytest.raises(ValueError, match=r"^dt is 0.0011 s, above the largest stable 0.001 s .* coarser mesh$"):
        check_dt(1.1e-3, 1e-3)
