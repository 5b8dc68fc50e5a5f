"""Capsules against capsules and spheres: MuJoCo's contacts, derivatives, finite where capsules are parallel or cross."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rewax.physics.rigid.capsules import capsule_capsule, sphere_capsule

SIZES = np.array([[0.05, 0.2], [0.08, 0.12]])
NUM = 300


@pytest.fixture(scope="module")
def capsules():
    """Centres and axes of pairs near each other: ends meet ends, ends sides, sides sides."""
    rng = np.random.default_rng(0)
    axes = rng.standard_normal((2, NUM, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    centers = rng.uniform(-0.2, 0.2, (2, NUM, 3))
    return [(centers[k], axes[k], np.tile(SIZES[k], (NUM, 1))) for k in range(2)]


def test_contacts_are_mujocos(x64, capsules):
    distance, point, normal = (np.asarray(a) for a in jax.jit(capsule_capsule)(*capsules[0], *capsules[1]))
    geom = '<body><freejoint/><geom name="{}" type="capsule" size="{} {}" contype="0" conaffinity="0"/></body>'
    bodies = geom.format("a", *SIZES[0]) + geom.format("b", *SIZES[1])
    pair = '<contact><pair geom1="a" geom2="b" margin="9"/></contact>'
    mj = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody>{pair}</mujoco>")
    data, compared = mujoco.MjData(mj), 0
    for i in range(NUM):
        for k, (center, axis, _) in enumerate(capsules):
            data.qpos[7 * k : 7 * k + 3] = center[i]
            mujoco.mju_quatZ2Vec(data.qpos[7 * k + 3 : 7 * k + 7], axis[i])
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_collision(mj, data)
        if len(data.contact) != 1 or distance[i] < -0.12:
            continue  # almost parallel, or axes that almost cross
        compared += 1
        (theirs,) = data.contact
        np.testing.assert_allclose(distance[i], theirs.dist, atol=1e-7)
        np.testing.assert_allclose(normal[i], theirs.frame[:3], atol=1e-4)
        np.testing.assert_allclose(point[i], theirs.pos, atol=1e-4)
    assert compared > 250 and np.mean(distance < 0) > 0.2


def test_contacts_of_spheres_are_mujocos(x64, capsules):
    """Beside the axis and beyond its ends."""
    (place, _, _), (center, axis, size) = capsules
    found = [np.asarray(a) for a in jax.jit(sphere_capsule)(place, np.full(NUM, 0.07), center, axis, size)]
    mj = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody><body><freejoint/><geom name="a" size=".07"/></body>
      <body><freejoint/><geom name="b" type="capsule" size="{size[0][0]} {size[0][1]}"/></body></worldbody>
      <contact><pair geom1="a" geom2="b" margin="9"/></contact></mujoco>""")
    data = mujoco.MjData(mj)
    for i, (distance, point, normal) in enumerate(zip(*found, strict=True)):
        data.qpos[:3], data.qpos[7:10] = place[i], center[i]
        mujoco.mju_quatZ2Vec(data.qpos[10:], axis[i])
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_collision(mj, data)
        (theirs,) = data.contact
        np.testing.assert_allclose(
            [distance, *point, *normal], [theirs.dist, *theirs.pos, *theirs.frame[:3]], atol=1e-9
        )


def test_capsules_that_are_almost_parallel_touch_where_they_are_nearest(x64):
    """At angles of a hundredth, without the margin for derivatives: against all pairs of points on their axes."""
    axis = np.array([[0.01, 0.0, 1.0], [0.0, -0.02, 1.0], [-0.01, 0.01, 1.0]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    up, size = np.tile([0.0, 0.0, 1.0], (3, 1)), np.tile(SIZES[0], (3, 1))
    center = np.array([[0.02, 0.08, 0.05], [0.09, 0.01, -0.03], [-0.001, 0.09, 0.02]])
    program = jax.jit(capsule_capsule, static_argnames="parallel")
    distance, _, _ = program(np.zeros((3, 3)), up, size, center, axis, size, parallel=1e-15)
    place = np.linspace(-0.2, 0.2, 1001)
    for pair in range(3):
        first, second = place[:, None] * up[pair], center[pair] + place[:, None] * axis[pair]
        gaps = np.linalg.norm(first[:, None] - second, axis=-1)
        np.testing.assert_allclose(distance[pair], gaps.min() - 0.1, atol=1e-8)


def test_derivatives_are_those_of_finite_differences(
    x64, capsules, derivatives, central_difference, random_like, inner
):
    x = jax.tree.map(jnp.asarray, (*capsules[0], *capsules[1]))
    dx = random_like(2, x)
    _, forward, weights, reverse = derivatives(lambda x: capsule_capsule(*x))(x, dx, lambda v: random_like(3, v))
    expected = central_difference(jax.jit(lambda x: capsule_capsule(*x)), x, dx, 1e-7)
    apart = np.asarray(forward[0] * 0 + jax.jit(capsule_capsule)(*x)[0]) > -0.12
    for found, true in zip(forward, expected, strict=True):
        error = np.abs(found - true).reshape(NUM, -1).max(axis=1)[apart]
        assert np.quantile(error, 0.98) < 1e-5
    assert inner(weights, forward) == pytest.approx(inner(reverse, dx), rel=1e-9)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_capsules_without_length_grow_at_both_ends(x64, side):
    """By the half length of each capsule, towards a sphere and towards another capsule."""
    up, center, ball = jnp.array([[0.0, 0.0, 1.0]]), jnp.array([[0.1, 0.0, 0.5 * side]]), jnp.array([0.05])

    def distances(half_lengths):
        first, second = (jnp.stack([ball, half[None]], axis=-1) for half in half_lengths)
        tilted = jnp.array([[0.6, 0.0, 0.8]])
        of_sphere = sphere_capsule(center, ball, jnp.zeros((1, 3)), up, first)[0]
        return jnp.stack([of_sphere, capsule_capsule(jnp.zeros((1, 3)), up, first, center, tilted, second)[0]])[:, 0]

    none = jnp.zeros(2)
    expected = np.stack([(distances(none.at[k].set(1e-7)) - distances(none)) / 1e-7 for k in range(2)], axis=1)
    assert expected[0, 0] < -0.9 and np.all(expected[1] < -0.6)
    for slope in (jax.jacrev(distances)(none), jax.jacfwd(distances)(none)):
        np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("precision", [False, True])
def test_derivatives_are_finite_where_axes_are_parallel_or_cross(precision):
    with jax.enable_x64(precision):
        center = jnp.array([[0.0, 0.1, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
        axis = jnp.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
        up, size = jnp.tile(jnp.array([0.0, 0.0, 1.0]), (4, 1)), jnp.tile(jnp.array([0.05, 0.2]), (4, 1))
        inputs = (jnp.zeros((4, 3)), up, size, center, axis, size)
        slopes = jax.jit(jax.jacrev(capsule_capsule, argnums=range(6)))(*inputs)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
        distance, point, _ = capsule_capsule(*inputs)
        np.testing.assert_allclose(distance, [0.0, -0.1, 0.0, -0.1], atol=1e-6)
        # Parallel ones touch in the middle of the first.
        np.testing.assert_allclose(point[0], [0.0, 0.05, 0.0], atol=1e-6)
