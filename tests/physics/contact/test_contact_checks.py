"""What numbers of colliders, of the ground and of the penalty law may be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.contact import Collider, Ground, PenaltyContact
from rewax.physics.contact.contact_checks import check_ground, collider_numbers, ground_numbers, penalty_numbers
from rewax.physics.numerics import static_poses
from rewax.physics.numerics.checks import any_illegal, check_numbers
from rewax.physics.shapes import Sphere

BALL = Collider(shape=Sphere(radius=0.1), friction=0.5, softness=666.0)
LAW = PenaltyContact(stiffness=1.0)


@pytest.mark.parametrize("field", [f.name for f in dataclasses.fields(PenaltyContact)])
def test_every_number_of_the_penalty_law_is_checked(field):
    check_numbers(penalty_numbers(LAW))
    with pytest.raises(ValueError, match=rf"^law\.{field}\[1\] is -1\.0, but must be"):
        check_numbers(penalty_numbers(LAW.replace(**{field: np.array([1.0, -1.0])}), "law"))


@pytest.mark.parametrize("field", ["offset", "rotation", "friction", "softness"])
def test_every_number_of_a_collider_is_checked(field):
    broken = BALL.replace(**{field: np.full(np.shape(getattr(BALL, field)), np.nan)})
    check_numbers(collider_numbers((BALL, BALL)))
    with pytest.raises(ValueError, match=rf"^colliders\[1\]\.{field}.* is nan, but must be .*finite"):
        check_numbers(collider_numbers((BALL, broken)))


def test_poses_count_where_there_are_colliders():
    poses = static_poses(2, 1)
    broken = poses._replace(position=poses.position * jnp.nan)
    assert any_illegal(collider_numbers((BALL,), broken))
    assert not any_illegal(collider_numbers((BALL,), poses))
    assert not any_illegal(collider_numbers((), broken))
    check = jax.jit(lambda last: any_illegal(collider_numbers((BALL,), poses._replace(rotation=last))))
    mirror = np.diag([1.0, 1.0, -1.0])
    for matrix, bad in ((np.eye(3)[[1, 2, 0]], False), (1.01 * np.eye(3), True), (mirror, True)):
        assert bool(check(poses.rotation.at[-1, 0].set(matrix))) == bad  # one boundary of a substep


def test_the_ground_has_a_unit_normal():
    check_ground(Ground(normal=np.array([0.6, 0.8, 0.0])))
    with pytest.raises(ValueError, match=r"^ground\.normal has length 2: give a unit vector"):
        check_ground(Ground(normal=np.array([0.0, 2.0, 0.0])))
    bad = jax.jit(lambda height: any_illegal(ground_numbers(Ground(normal=np.eye(3)[1], height=height))))
    assert bad(jnp.inf) and not bad(-1.0)
    tilted = jax.jit(lambda normal: any_illegal(ground_numbers(Ground(normal=normal))))
    assert tilted(jnp.array([0.0, 1.3, 0.0])) and tilted(jnp.zeros(3)) and not tilted(jnp.array([0.6, 0.8, 0.0]))
    assert any_illegal(ground_numbers(Ground(normal=np.array([0.0, 1.3, 0.0]))))


def test_a_collider_has_a_rotation_matrix():
    turned = jax.jit(lambda rotation: any_illegal(collider_numbers((BALL.replace(rotation=rotation),))))
    a, b = np.cos(0.3), np.sin(0.3)
    legal = [np.eye(3), np.array([[a, -b, 0.0], [b, a, 0.0], [0.0, 0.0, 1.0]])]
    illegal = [2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.eye(3) + 0.1 * np.eye(3)[[1, 2, 0]], np.zeros((3, 3))]
    for matrix, bad in [*((m, False) for m in legal), *((m, True) for m in illegal)]:
        assert bool(turned(matrix)) == bool(any_illegal(collider_numbers((BALL.replace(rotation=matrix),)))) == bad
