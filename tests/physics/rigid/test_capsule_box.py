"""Capsules on boxes: MuJoCo's one or two contacts, by hand, derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics.rigid.capsule_box import capsule_box
from rewax.xla_options import unoptimised

SIZE, HALF = np.array([0.03, 0.06]), np.array([0.05, 0.03, 0.04])
NUM = 400
QUICK = unoptimised()
MANY = jax.jit(jax.vmap(capsule_box, in_axes=(0, 0, None, None, None, None)), compiler_options=QUICK)
BOX = np.zeros(3), np.eye(3), HALF


def one(center, axis):
    """Contacts of one capsule, by the program that serves many."""
    return (np.asarray(a)[0] for a in MANY(np.tile(center, (NUM, 1)), np.tile(axis, (NUM, 1)), SIZE, *BOX))


@pytest.fixture(scope="module")
def capsules():
    """Centres and axes around a box: over faces, along and across edges, at corners, inside; a third almost aligned."""
    rng = np.random.default_rng(0)
    axis = rng.standard_normal((NUM, 3))
    axis[: NUM // 3] = np.eye(3)[rng.integers(3, size=NUM // 3)] + 0.1 * axis[: NUM // 3]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return rng.uniform(-0.1, 0.1, (NUM, 3)), axis


def test_contacts_are_mujocos(x64, capsules):
    center, axis = capsules
    found = [np.asarray(a) for a in MANY(center, axis, SIZE, *BOX)]
    mj = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom type="box" size=".05 .03 .04"/>
      <body><freejoint/><geom type="capsule" size=".03 .06"/></body></worldbody></mujoco>""")
    data, counts = mujoco.MjData(mj), []
    for i, (distance, point, normal) in enumerate(zip(*found, strict=True)):
        data.qpos[:3] = center[i]
        mujoco.mju_quatZ2Vec(data.qpos[3:], axis[i])
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_collision(mj, data)
        on = distance < 0
        sign = [1.0 if mj.geom_type[c.geom[0]] == mujoco.mjtGeom.mjGEOM_CAPSULE else -1.0 for c in data.contact]
        theirs = [[c.dist, *c.pos, *s * c.frame[:3]] for s, c in zip(sign, data.contact, strict=True)]
        ours = np.column_stack([distance, point, normal])[on]
        assert len(ours) == len(theirs), i
        np.testing.assert_allclose(sorted(map(tuple, ours)), sorted(map(tuple, theirs)), atol=1e-8)
        counts.append(len(ours))
    assert np.bincount(counts).min() > NUM // 20


def test_a_capsule_that_lies_touches_at_both_ends_of_what_is_over_the_face(x64):
    """Along x, 1 cm deep, 2 cm beyond one rim: at its end and at the rim."""
    distance, point, normal = one([0.01, 0.0, 0.06], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(distance, -0.01, atol=1e-12)
    np.testing.assert_allclose(sorted(np.asarray(point)[:, 0]), [-0.05, 0.05], atol=1e-12)
    np.testing.assert_allclose(point[:, 2], 0.035, atol=1e-12)
    np.testing.assert_allclose(normal, np.tile([0.0, 0.0, -1.0], (2, 1)), atol=1e-12)


def test_a_capsule_that_stands_touches_once(x64):
    distance, point, _ = one([0.0, 0.0, 0.12], [0.0, 0.0, 1.0])
    first = int(np.argmin(distance))
    np.testing.assert_allclose([distance[first], *point[first]], [-0.01, 0.0, 0.0, 0.035], atol=1e-12)
    assert distance[1 - first] > 0


def test_derivatives_are_those_of_finite_differences(
    x64, capsules, derivatives, central_difference, random_like, inner
):
    """By all, of capsules that touch or nearly do and whose axes stay outside: at those inside the nearest face jumps."""
    x = jax.tree.map(jnp.asarray, (*capsules, SIZE, *BOX))
    dx = random_like(2, x)

    def contact(x):
        found = jax.vmap(capsule_box, in_axes=(0, 0, None, None, None, None))(*x)
        near = (found[0] > -0.02) & (found[0] < 0.5)
        return jax.tree.map(lambda a: jnp.where(near.reshape(near.shape + (1,) * (a.ndim - 2)), a, 0.0), found)

    _, forward, weights, reverse = derivatives(contact, compiler_options=QUICK)(x, dx, lambda v: random_like(3, v))
    expected = central_difference(jax.jit(contact, compiler_options=QUICK), x, dx, 1e-8)
    for found, true in zip(forward, expected, strict=True):
        error = np.abs(found - true).reshape(NUM, -1).max(axis=1)
        assert np.mean(error < 1e-4) > 0.9, np.quantile(error, [0.5, 0.8, 0.9])
    assert inner(weights, forward) == pytest.approx(inner(reverse, dx), rel=1e-9)


def test_derivatives_are_finite_where_capsules_are_aligned_with_edges():
    with jax.enable_x64(False):
        slopes_at = jax.jit(jax.jacrev(capsule_box, argnums=range(6)), compiler_options=QUICK)
        for center, axis in (((0, 0.03, 0.06), (1, 0, 0)), ((0, 0, 0.06), (1, 0, 0)), ((0, 0, 0.1), (0, 0, 1))):
            inputs = [jnp.asarray(a, float) for a in (center, axis, SIZE, *BOX)]
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes_at(*inputs)))


def test_a_capsule_along_an_axis_of_the_box_touches_twice(x64):
    """Exactly aligned, over faces and beside edges. MuJoCo finds both contacts in at least one of its directions."""
    mj = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom type="box" size=".05 .03 .04"/>
      <body><freejoint/><geom type="capsule" size=".03 .06"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(mj)

    def theirs(center, axis):
        data.qpos[:3] = center
        mujoco.mju_quatZ2Vec(data.qpos[3:], axis)
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_collision(mj, data)
        return sorted((c.dist, *c.pos) for c in data.contact)

    for axis in (*np.eye(3), *-np.eye(3)):
        for side in (np.roll(axis, 1), np.roll(axis, 2)):
            for shift in (0.0, 0.02):
                center = side * (HALF + 0.025) + axis * shift
                distance, point, _ = one(center, axis)
                ours = sorted(map(tuple, np.column_stack([distance, point])[distance < 0]))
                expected = max(theirs(center, axis), theirs(center, -axis), key=len)
                assert len(expected) == 2
                np.testing.assert_allclose(ours, expected, atol=1e-8, err_msg=f"{axis} {side} {shift}")
