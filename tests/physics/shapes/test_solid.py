"""What ``distance`` and ``bounding_box`` of a user's shape may return."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_shapes import Torus

from rewax import struct
from rewax.physics.contact.colliders import Collider, apply_collider
from rewax.physics.contact.penalty import surface
from rewax.physics.contact.penetration import penetration
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import fill, signed_distance
from rewax.physics.shapes.solid import corners_of, distance_to

POINTS = tuple(jnp.full(5, a) for a in (0.1, 0.2, 0.3))
BODY = Pose(jnp.zeros(3), jnp.eye(3))
BODIES = Pose(BODY.position[None], BODY.rotation[None])


def mine(**methods) -> Torus:
    return struct.dataclass(type("Mine", (Torus,), methods))(ring=0.3, tube=0.1)


def collider(shape) -> Collider:
    return Collider(shape=shape, friction=0.5, softness=666.0)


USES = {
    "particles": lambda shape: apply_collider(collider(shape), POINTS, POINTS, BODY, BODY, 1e-3),
    "vertices": lambda shape: surface(collider(shape), POINTS, BODY),
    "depth": lambda shape: penetration([collider(shape)], BODIES, POINTS),
    "lattice": lambda shape: fill(shape, 0.1),
    "volume": lambda shape: shape.volume(),
    "rays": lambda shape: shape.cast(POINTS, POINTS),
    "alone": lambda shape: signed_distance(shape, np.ones((2, 3))),
}
WRONG = {
    "distance alone": lambda d, n: d,
    "nothing": lambda d, n: None,
    "an array": lambda d, n: (d, jnp.stack(n, axis=-1)),
    "two components": lambda d, n: (d, n[:2]),
}


@pytest.mark.parametrize("use", USES.values(), ids=USES)
@pytest.mark.parametrize("result", WRONG.values(), ids=WRONG)
def test_a_distance_of_another_form_is_named_wherever_it_is_used(use, result):
    shape = mine(distance=lambda self, p: result(*Torus.distance(self, p)))
    with pytest.raises(
        ValueError, match=r"^Mine\.distance returned .*: return the signed distance and the normal's comp"
    ):
        use(shape)


@pytest.mark.parametrize("corners", [None, (-np.ones(3),), (0.0, 1.0), (-np.ones(2), np.ones(2)), np.ones((3, 3))])
def test_bounds_of_another_form_are_named_wherever_they_are_used(corners):
    shape = mine(bounding_box=lambda self: corners)
    sentence = "^" + re.escape("Mine.bounding_box returned ") + ".*: return the lower and the upper corner in metres"
    for use in (corners_of, lambda s: s.bounding_radius(), lambda s: s.volume(), lambda s: fill(s, 0.1)):
        with pytest.raises(ValueError, match=sentence):
            use(shape)


def test_legal_forms_pass_as_they_are():
    distance, normal = distance_to(mine(), POINTS)
    np.testing.assert_array_equal(distance, Torus(ring=0.3, tube=0.1).distance(POINTS)[0])
    assert [component.shape for component in normal] == 3 * [(5,)]
    for given in (((-1.0,) * 3, np.ones(3)), np.array([[-1.0] * 3, [1.0] * 3]), [jnp.full(3, -1.0), (1.0,) * 3]):
        shape = mine(bounding_box=lambda self, given=given: given)
        np.testing.assert_array_equal(np.stack(corners_of(shape)), [[-1.0] * 3, [1.0] * 3])
        assert shape.bounding_radius() == pytest.approx(3**0.5)
    traced = jax.jit(lambda c: corners_of(mine(bounding_box=lambda self: ((c, c, c), jnp.stack([c, c, c]))))[1])
    np.testing.assert_array_equal(traced(2.0), np.full(3, 2.0))
