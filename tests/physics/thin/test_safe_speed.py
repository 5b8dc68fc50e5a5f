"""What self-contact refuses when a scene is built."""

import pytest
from self_contact_bodies import law
from thin_bodies import SHEET, cloth_scene

REFUSED = [
    ({"thickness": -1.0}, "self_contact.thickness is -1.0"),
    ({"thickness": 0.06}, "more than half of the smallest height"),
    ({"max_speed": 100.0}, "self_contact.max_speed is 100"),
    ({"stiffness": 1e7}, "above the largest stable"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_illegal_self_contact_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        cloth_scene(SHEET, self_contact=law(**changes))
