"""Bits of a status in words."""

from rewax.status import Status, describe, remedy


def test_a_status_says_what_is_wrong_and_what_helps():
    both = Status.INACTIVE_NODES | Status.FAR_COLLIDERS
    assert describe(both) == "INACTIVE_NODES|FAR_COLLIDERS"
    assert remedy(both) == "a larger max_active_nodes, a larger max_near_colliders"
    assert remedy(Status.NAN) == "shorter substeps or softer contacts"
    assert remedy(Status.NAN | Status.INVALID_PARAMETERS) == (
        "numbers that make_scene or load accept, shorter substeps or softer contacts"
    )
