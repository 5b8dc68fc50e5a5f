"""Penalty contact: each case of the law by hand, ground and shapes, moving bodies, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.penalty import Ground, PenaltyContact, collider_force, ground_force
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Box, Capsule, Plane, Sphere

EYE, ORIGIN, DT = jnp.eye(3), jnp.zeros(3), 1e-3
REST = Pose(ORIGIN, EYE)
LAW = PenaltyContact(stiffness=2000.0, damping=3.0, friction_damping=10.0, friction=0.5, radius=0.05)


def on_ground(x, v, law=LAW, normal=(0.0, 1.0, 0.0), height=0.0):
    ground = Ground(normal=jnp.asarray(normal), height=height)
    return cp.join_vector(ground_force(ground, law, *(cp.split_vector(jnp.asarray(a, float)) for a in (x, v))))


def on_collider(collider, x, v, before=REST, after=REST, law=LAW):
    x, v = (cp.split_vector(jnp.asarray(a, float)) for a in (x, v))
    return cp.join_vector(collider_force(collider, law, x, v, before, after, DT))


def collider(shape, friction=0.5, rotation=EYE, offset=ORIGIN):
    return Collider(shape=shape, offset=jnp.asarray(offset), rotation=jnp.asarray(rotation), friction=friction)


@pytest.mark.parametrize(
    ("y", "v", "force"),
    [
        (0.051, [1.0, -2.0, 3.0], [0, 0, 0]),  # no contact outside the radius
        (0.04, [0.0, 0.0, 0.0], [0, 20, 0]),  # 0.01 deep
        (0.04, [0.0, -2.0, 0.0], [0, 26, 0]),  # damped on the way in,
        (0.04, [0.0, 2.0, 0.0], [0, 20, 0]),  # not on the way out
        (0.04, [0.3, 0.0, -0.4], [-3, 20, 4]),  # sticking: 10 |v_t| = 5 is below 0.5 * 20
        (0.04, [3.0, 0.0, -4.0], [-6, 20, 8]),  # sliding: Coulomb's 10, against the motion
        (0.04, [3.0, -2.0, -4.0], [-7.8, 26, 10.4]),  # the limit counts damping
    ],
)
def test_each_case_of_the_law(x64, y, v, force):
    np.testing.assert_allclose(on_ground([[7.0, y, -3.0]], [v])[0], force, atol=1e-11)
    ground = collider(Plane())
    np.testing.assert_allclose(on_collider(ground, [[7.0, y, -3.0]], [v])[0], force, atol=1e-11)


def test_damping_by_depth(x64):
    """Per depth and speed, in addition to the other damping, which alone has an onset; friction's limit counts it."""
    law = LAW.replace(depth_damping=150.0)
    x = [[0.0, 0.04, 0.0], [0.0, 0.03, 0.0], [0.0, 0.04, 0.0], [0.0, 0.04, 0.0]]
    v = [[0.0, -2.0, 0.0], [0.0, -2.0, 0.0], [0.0, 2.0, 0.0], [9.0, -2.0, 0.0]]
    expected = [[0, 20 + 6 + 3, 0], [0, 40 + 6 + 6, 0], [0, 20, 0], [-14.5, 29, 0]]
    np.testing.assert_allclose(on_ground(x, v, law), expected, atol=1e-11)
    np.testing.assert_allclose(on_ground(x, v, law.replace(onset=0.02))[0], [0, 20 + 3 + 3, 0], atol=1e-11)


def test_grounds_of_any_direction_and_height(x64):
    """The same in a frame that is turned and shifted."""
    q, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    q *= np.linalg.det(q)
    x, v = np.array([0.2, 0.03, 0.1]), np.array([1.0, -2.0, 0.5])
    turned = on_ground([q @ (x + [0, 0.7, 0])], [q @ v], normal=q[:, 1], height=0.7)[0]
    np.testing.assert_allclose(turned, q @ np.asarray(on_ground([x], [v])[0]), atol=1e-10)


def test_colliders_push_along_their_normals(x64):
    """A ball, a capsule's side and a box's face, each 0.01 deep from its own side; bodies and offsets turned."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x to y, y to -x
    at = Pose(jnp.array([1.0, 2.0, 3.0]), jnp.asarray(turn))
    still = [[0.0, 0.0, 0.0]]
    n = np.array([0.6, 0.0, 0.8])
    ball = collider(Sphere(radius=0.3))
    np.testing.assert_allclose(on_collider(ball, [0.34 * n], still)[0], 20 * n, atol=1e-10)
    # The capsule's axis is y, turned to -x by the body and shifted by its offset, which turns too.
    rod = collider(Capsule(radius=0.1, half_length=0.5), offset=[0.2, 0.0, 0.0])
    place = [[1.3, 2.2, 3.0 + 0.14]]
    np.testing.assert_allclose(on_collider(rod, place, still, at, at)[0], [0, 0, 20], atol=1e-10)
    block = collider(Box(half_size=jnp.array([0.1, 0.2, 0.3])), rotation=turn)
    np.testing.assert_allclose(on_collider(block, [[-0.24, 0.02, 0.1]], still)[0], [-20, 0, 0], atol=1e-10)


def test_friction_counts_from_the_surface_that_moves(x64):
    """A belt drags; a vertex that goes along feels the normal force alone; a turning ball has its points' velocities."""
    belt, x = collider(Plane()), [[0.3, 0.04, 0.1]]
    speed = np.array([0.5, 0.0, -0.2])
    ahead = Pose(jnp.asarray(speed * DT), EYE)
    np.testing.assert_allclose(on_collider(belt, x, [speed], REST, ahead)[0], [0, 20, 0], atol=1e-9)
    np.testing.assert_allclose(on_collider(belt, x, [[0, 0, 0]], REST, ahead)[0], [5, 20, -2], atol=1e-9)
    slippery = collider(Plane(), friction=0.1)  # its own, not the ground's
    np.testing.assert_allclose(on_collider(slippery, x, [[3.0, 0, -4.0]])[0], [-1.2, 20, 1.6], atol=1e-9)
    rising = Pose(jnp.array([0.0, 2.0 * DT, 0.0]), EYE)
    np.testing.assert_allclose(on_collider(belt, x, [[0, 0, 0]], REST, rising)[0], [0, 26, 0], atol=1e-9)
    omega = 2.0
    c, s = np.cos(omega * DT), np.sin(omega * DT)
    turned = Pose(ORIGIN, jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
    force = on_collider(collider(Sphere(radius=0.3), friction=9.0), [[0.34, 0.0, 0.0]], [[0, 0, 0]], REST, turned)[0]
    np.testing.assert_allclose(force, [20, 10 * omega * 0.34, 0], atol=0.01)


def test_derivatives_equal_finite_differences(x64, random_like, central_difference, relative_error):
    """Of free, sticking and sliding vertices on a box and on the ground, with respect to everything at once."""
    rng = np.random.default_rng(0)
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    poses = Pose(jnp.array([[0.0, 0.0, 0.0], [1e-3, -2e-3, 0.0]]), jnp.asarray(np.stack([q, q + 1e-3])))
    block = collider(
        Box(half_size=jnp.array([0.3, 0.2, 0.25])), friction=jnp.array(0.4), rotation=q, offset=[0.1, 0.0, 0.2]
    )
    ground = Ground(normal=jnp.array([0.0, 1.0, 0.0]), height=jnp.array(-0.2))
    x, v = jnp.asarray(rng.uniform(-0.4, 0.4, (64, 3))), jnp.asarray(3.0 * rng.standard_normal((64, 3)))
    law = jax.tree.map(lambda a: jnp.asarray(a, float), LAW)

    @jax.jit
    def force(args):
        block, ground, law, x, v, poses = args
        before, after = (jax.tree.map(lambda p, t=t: p[t], poses) for t in (0, 1))
        x, v = cp.split_vector(x), cp.split_vector(v)
        both = cp.add(ground_force(ground, law, x, v), collider_force(block, law, x, v, before, after, DT))
        return cp.join_vector(both)

    args = (block, ground, law, x, v, poses)
    touched = np.any(force(args) != 0, axis=1)
    assert 8 < touched.sum() < 60
    direction = random_like(1, args)
    tangent = jax.jit(lambda a, d: jax.jvp(force, (a,), (d,))[1])(args, direction)
    assert relative_error(tangent, central_difference(force, args, direction, 1e-8)) < 1e-6


def test_derivatives_at_rest_are_finite(x64):
    """No tangential velocity, no depth, at the middle of a ball: where norms are zero."""

    def total(x, v):
        ball = collider(Sphere(radius=jnp.array(0.3)))
        return jnp.sum(on_ground(x, v) ** 2) + jnp.sum(on_collider(ball, x, v) ** 2)

    x = jnp.array([[0.0, 0.04, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.0], [0.35, 0.0, 0.0]])
    for gradient in jax.jit(jax.grad(total, argnums=(0, 1)))(x, jnp.zeros_like(x)):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize(("friction", "slope"), [(0.0, 0.0), (0.5, -10.0)])
def test_without_friction_nothing_holds_a_vertex_that_does_not_slide(x64, central_difference, friction, slope):
    def drag(speed):
        return on_ground([[0.0, 0.04, 0.0]], [[speed, -1.0, 0.0]], LAW.replace(friction=friction))[0, 0]

    still = jnp.asarray(0.0)
    assert jax.grad(drag)(still) == jax.jvp(drag, (still,), (1.0,))[1] == slope
    np.testing.assert_allclose(central_difference(drag, still, 1.0), slope, rtol=1e-9)
    assert jax.grad(drag)(jnp.zeros((), jnp.float32)) == slope


def test_a_body_at_rest_does_not_rub_what_is_at_rest():
    """In float32, far from the origin and with a short substep: no velocity comes from rounding."""
    still = Pose(jnp.array([1.3, 0.7, -2.1]), jnp.eye(3))
    block = Collider(shape=Box(half_size=jnp.array([0.5, 0.1, 0.5])), friction=0.7)
    x = jnp.array([[1.37, 0.79, -2.03], [1.11, 0.795, -1.97]], jnp.float32)
    law = PenaltyContact(stiffness=2e3, damping=100.0, friction_damping=10.0)
    force = collider_force(block, law, cp.split_vector(x), cp.split_vector(jnp.zeros_like(x)), still, still, 1e-5)
    np.testing.assert_array_equal(np.stack([force[0], force[2]]), 0.0)
    assert float(force[1].min()) > 0.0
