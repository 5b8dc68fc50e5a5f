"""Bits of a status in words."""

import numpy as np
import pytest

from rewax.status import Status, describe, remedy


def test_a_status_says_what_is_wrong_and_what_helps():
    both = Status.INACTIVE_NODES | Status.FAR_COLLIDERS
    assert describe(both) == "INACTIVE_NODES|FAR_COLLIDERS"
    assert remedy(both) == "a larger max_active_nodes, a larger max_near_colliders"
    assert remedy(Status.NAN) == "shorter substeps or softer contacts"
    assert remedy(Status.NAN | Status.INVALID_PARAMETERS) == (
        "numbers that make_scene or load accept, shorter substeps or softer contacts"
    )


@pytest.mark.parametrize("status", [2**40, -1, np.int32(4096)])
def test_bits_that_nobody_sets_are_refused(status):
    with pytest.raises(ValueError, match=rf"^status is {status}, which has bits that are none of Status: give a State"):
        describe(status)
    assert describe(np.int32(0)) == "OK"
