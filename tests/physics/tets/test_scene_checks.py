"""Numbers that no scene of tetrahedra can have are refused."""

import re

import numpy as np
import pytest
from tet_bodies import CONTACT, FLOOR, body

from rewax.physics.contact import Collider, Ground
from rewax.physics.shapes import Sphere

nan = float("nan")


def collider(radius=0.1, friction=0.5) -> dict:
    return {"colliders": (Collider(shape=Sphere(radius=radius), friction=friction),)}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"gravity": (0.0, nan, 0.0)}, "gravity[1] is nan, but must be finite: give an acceleration in m/s^2"),
        ({"contact": CONTACT, **collider(friction=-0.1)}, "colliders[0].friction is -0.1, but must be 0 or more"),
        ({"contact": CONTACT, **collider(radius=-1.0)}, "colliders[0].shape.radius is -1.0, but must be positive"),
        ({"contact": CONTACT.replace(onset=-1.0)}, "contact.onset is -1.0, but must be 0 or more: give a number of m"),
        ({"damping": [[]]}, "damping has shape (1, 0): give a number or an array of shape ("),
        ({"contact": CONTACT.replace(depth_damping=nan)}, "contact.depth_damping is nan, but must be 0 or more and finit"),
        ({"contact": CONTACT.replace(friction=np.full(3, 0.1))}, "contact.friction has shape (3,): give a number or an "),
        ({"contact": CONTACT, "ground": FLOOR.replace(height=nan)}, "ground.height is nan, but must be finite: give a dis"),
        ({"contact": 1e3}, "contact is 1000.0: give a PenaltyContact(stiffness=...)"),
        ({"contact": CONTACT, "ground": 0.0}, "ground is 0.0: give a Ground(normal=...)"),
        ({"contact": CONTACT, "ground": Ground(normal=np.full(3, nan))}, "ground.normal[0] is nan, but must be finite: gi"),
    ],
)  # fmt: skip
def test_tet_scenes_refuse_impossible_numbers(changes, sentence):
    body(contact=CONTACT, ground=FLOOR, **collider())
    with pytest.raises(ValueError, match="^" + re.escape(sentence)):
        body(**changes)
