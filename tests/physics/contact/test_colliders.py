"""Contact on grid velocities: each case of the friction law by hand, moving bodies, several colliders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.kit.soft_parts import turn_about_y
from rewax.physics.contact.colliders import (
    Collider,
    Overlap,
    apply_collider,
    apply_colliders,
    check_bodies,
    nearest,
    place,
    runs,
    touch,
    with_softness,
)
from rewax.physics.contact.motion import Motion, placed
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.shapes import Box, Capsule, Plane, Sphere

EYE, ORIGIN, DT = jnp.eye(3), jnp.zeros(3), 1e-3
REST = Pose(ORIGIN, EYE)


def ground(friction=0.5, softness=100.0) -> Collider:
    return Collider(shape=Plane(), offset=ORIGIN, rotation=EYE, friction=friction, softness=softness)


def contact(collider, node, velocity, before=REST, after=REST):
    """Velocity of one node after contact, shape (3,)."""
    node, velocity = (jnp.asarray(a, float)[None] for a in (node, velocity))
    return np.asarray(after_contact(collider, node, velocity, before, after))[0]


def after_contact(collider, nodes, velocity, before, after):
    """Velocities (N, 3) of nodes (N, 3) after contact."""
    position = cp.split_vector(nodes)
    return cp.join_vector(apply_collider(collider, position, cp.split_vector(velocity), before, after, DT))


UNDER, AT = [0.3, -0.05, 0.1], [0.3, 0.0, 0.1]


def test_sticking(x64):
    """Coulomb's limit 0.5 * 2 exceeds the tangential speed 0.6."""
    np.testing.assert_allclose(contact(ground(), UNDER, [0.6, -2.0, 0.0]), 0.0, atol=1e-14)


def test_rounding_does_not_decide_the_velocity_of_a_node_on_an_edge():
    """A paddle at a round position, turned by pi: nodes lie on its edge, up to the rounding of their coordinates."""
    nodes = jnp.asarray([[0.395, 0.135, 0.25], [0.395, 0.135, 0.35]], jnp.float32)
    velocity = jnp.asarray([[0.3, 0.1, -0.2], [0.3, 0.1, 0.2]], jnp.float32)
    box = Collider(shape=Box(half_size=(0.025, 0.06, 0.05)), friction=0.2, softness=300.0)

    def after(shift):
        turned = turn_about_y(jnp.asarray(np.pi, jnp.float32))
        pose = Pose(jnp.asarray([0.42, 0.135, 0.3], jnp.float32) + shift, turned)
        return after_contact(box, nodes, velocity, pose, pose)

    shifts = jnp.asarray(np.random.default_rng(1).uniform(-1e-7, 1e-7, (20, 3)), jnp.float32)
    assert np.ptp(jax.jit(jax.vmap(after))(shifts), axis=0).max() < 1e-4
    assert np.abs(jax.jit(jax.vmap(jax.jacrev(after)))(shifts)).max() < 200.0  # softness times speed, not 1e6


def test_sliding_loses_friction_times_normal_impulse(x64):
    np.testing.assert_allclose(contact(ground(), UNDER, [3.0, -2.0, 4.0]), [3.0 * 0.8, 0.0, 4.0 * 0.8], rtol=1e-12)
    np.testing.assert_allclose(contact(ground(friction=0.0), AT, [3.0, -2.0, 4.0]), [3.0, 0.0, 4.0], atol=1e-12)


def test_a_node_that_moves_straight_down_is_held_for_small_tangential_velocities():
    def slope(velocity):
        after = lambda v: after_contact(ground(), jnp.array([UNDER]), v[None], REST, REST)[0]  # noqa: E731
        return jax.jvp(after, (velocity,), (jnp.array([1.0, 0.0, 1.0]),))[1]

    down = jnp.array([0.0, -2.0, 0.0])
    np.testing.assert_array_equal(slope(down), 0.0)
    np.testing.assert_allclose(slope(-down), [1.0, 0.0, 1.0], rtol=1e-6)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_without_normal_velocity_the_derivative_is_that_of_leaving(x64, friction):
    """Also after three contacts."""

    def after(velocity):
        for _ in range(3):
            velocity = after_contact(ground(friction), jnp.array([UNDER]), velocity[None], REST, REST)[0]
        return velocity

    along, up = jnp.array([0.6, 0.0, 0.0]), jnp.array([0.3, 1.0, 0.2])
    np.testing.assert_allclose((after(along + 1e-6 * up) - after(along)) / 1e-6, up, rtol=1e-9)
    np.testing.assert_allclose(jax.jvp(after, (along,), (up,))[1], up, rtol=1e-12)
    np.testing.assert_allclose(jax.vjp(after, along)[1](up)[0], up, rtol=1e-12)


def test_separating_is_untouched(x64):
    np.testing.assert_array_equal(contact(ground(), UNDER, [3.0, 2.0, 4.0]), [3.0, 2.0, 4.0])


def test_influence_fades_with_distance_and_ends(x64):
    """At distance d the change is exp(-softness d) of the full one; beyond log(10) / softness there is none."""
    v, full = np.array([0.6, -2.0, 0.0]), np.zeros(3)
    near = contact(ground(), [0.0, 0.02, 0.0], v)
    np.testing.assert_allclose(near - v, np.exp(-2.0) * (full - v), rtol=1e-12)
    np.testing.assert_array_equal(contact(ground(), [0.0, 0.0231, 0.0], v), v)
    assert np.abs(contact(ground(), [0.0, 0.0229, 0.0], v) - v).max() > 0.1


def test_a_moving_body_drags_and_pushes(x64):
    """In the frame of the body the law is the same: Galilean invariance, and a node at rest is pushed and dragged."""
    shift, v = np.array([0.7, 1.5, -0.2]), np.array([1.0, -2.0, 0.5])
    moved = Pose(jnp.asarray(shift * DT), EYE)
    still = contact(ground(), UNDER, v)
    np.testing.assert_allclose(contact(ground(), UNDER, v + shift, REST, moved), still + shift, rtol=1e-12)
    np.testing.assert_allclose(contact(ground(friction=9.0), UNDER, [0.0, 0, 0], REST, moved), shift, rtol=1e-12)


def test_a_rotating_body_has_the_velocity_of_its_points(x64):
    """A sphere that turns about z by omega: a sticking node at its surface moves with omega x r, up to omega^2 dt."""
    omega, radius = 2.0, 0.3
    c, s = np.cos(omega * DT), np.sin(omega * DT)
    turned = Pose(ORIGIN, jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
    ball = Collider(shape=Sphere(radius=radius), offset=ORIGIN, rotation=EYE, friction=100.0, softness=666.0)
    got = contact(ball, [radius, 0.0, 0.0], [-1.0, 0.0, 0.0], REST, turned)
    np.testing.assert_allclose(got, [0.0, omega * radius, 0.0], atol=1.1 * 0.5 * omega**2 * DT * radius)


def test_offset_and_rotation_of_the_shape_in_its_body(x64):
    """A ground turned by 90 degrees about z is a wall whose normal is -x; it travels with offset and body."""
    turn = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    wall = ground(friction=0.0).replace(rotation=turn, offset=jnp.array([0.2, 0.0, 0.0]))
    body = Pose(jnp.array([1.0, 0.0, 0.0]), EYE)
    np.testing.assert_allclose(contact(wall, [1.3, 5.0, 0.0], [2.0, 1.0, 0.0], body, body), [0.0, 1.0, 0.0], atol=1e-14)
    np.testing.assert_array_equal(contact(wall, [1.1, 5.0, 0.0], [2.0, 1.0, 0.0], body, body), [2.0, 1.0, 0.0])
    # The whole body turned back: the ground is a ground again, and its offset turns with it.
    body = Pose(jnp.array([0.0, 0.5, 0.0]), turn.T)
    np.testing.assert_allclose(
        contact(wall, [0.0, 0.2, 0.0], [2.0, -1.0, 0.0], body, body), [2.0, 0.0, 0.0], atol=1e-14
    )
    np.testing.assert_array_equal(contact(wall, [0.0, 0.4, 0.0], [2.0, -1.0, 0.0], body, body), [2.0, -1.0, 0.0])


def test_derivatives_equal_finite_differences(x64, random_like, derivatives_agree):
    """Of sliding, sticking, separating and fading nodes, with respect to everything at once."""
    rng = np.random.default_rng(0)
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    poses = Pose(jnp.array([[0.0, 0.0, 0.0], [1e-3, -2e-3, 0.0]]), jnp.asarray(np.stack([q, q + 1e-3])))
    ball = Collider(shape=Sphere(radius=jnp.array(0.3)), offset=0.1 * jnp.ones(3), rotation=jnp.asarray(q), friction=jnp.array(0.4), softness=jnp.array(20.0))  # fmt: skip
    nodes, velocity = jnp.asarray(rng.uniform(-0.4, 0.4, (64, 3))), jnp.asarray(rng.standard_normal((64, 3)))

    def after(args):
        ball, velocity, poses = args
        before, behind = (jax.tree.map(lambda p, t=t: p[t], poses) for t in (0, 1))
        return after_contact(ball, nodes, velocity, before, behind)

    args = (ball, velocity, poses)
    value, _ = derivatives_agree(after, args, random_like(1, args), step=1e-8, bar=1e-6, exact=1e-11)
    touched = np.any(value != velocity, axis=1)
    assert 8 < touched.sum() < 60


def test_derivatives_are_finite_deep_inside_in_float32():
    """exp(softness depth) would overflow at 0.13 m with the reference's softness."""

    def after(height):
        floor = Collider(shape=Plane(), offset=jnp.array([0.0, 1.0, 0.0]) * height, friction=0.5, softness=666.0)
        nodes = jnp.array([[0.0, -0.5, 0.0], [0.0, -0.001, 0.0], [0.0, 0.001, 0.0], [0.0, 0.9, 0.0]])
        return jnp.sum(after_contact(floor, nodes, jnp.full((4, 3), -1.0), REST, REST))

    slope = jax.grad(after)(jnp.float32(0.0))
    assert np.isfinite(slope) and float(slope) > 1.0


def test_without_a_softness_contact_begins_one_cell_away(x64):
    spacing = 0.025
    soft, own = with_softness((ground(softness=None), ground(softness=7.0)), spacing)
    np.testing.assert_allclose(soft.softness, np.log(10.0) / spacing)
    assert own.softness == 7.0
    near, far = (contact(soft, [0.0, f * spacing, 0.0], [0.0, -1.0, 0.0]) for f in (0.99, 1.01))
    np.testing.assert_allclose(near, [0.0, -(1.0 - 0.1**0.99), 0.0], rtol=1e-12)
    np.testing.assert_array_equal(far, [0.0, -1.0, 0.0])
    with pytest.raises(ValueError, match=r"^softness is None, and no grid is known here: give a decay per metre"):
        contact(ground(softness=None), UNDER, [0.0, -1.0, 0.0])


def test_a_collider_of_a_body_without_pose_is_refused():
    with pytest.raises(ValueError, match="collider 1 belongs to body 2, but there are poses of 2 bodies: give"):
        check_bodies((ground(), ground().replace(body=2)), 2)


# --- Several colliders -------------------------------------------------------------------------------------------------


def several(colliders, nodes, velocity, before, after, overlap):
    """Velocities (N, 3) of nodes (N, 3) after contact with all of them."""
    position, v = cp.split_vector(nodes), cp.split_vector(velocity)
    placed = place(colliders, before, after, DT)
    moving = [(c, jax.tree.map(lambda a, i=i: a[i], placed)) for i, c in enumerate(colliders)]
    return cp.join_vector(apply_colliders(moving, position, v, overlap=overlap))


def fingers(rotations):
    """Five capsules, a box, four capsules on three moving bodies, all over each other, and nodes among them."""
    rng = np.random.default_rng(5)

    def one(k):
        sizes = {"radius": jnp.asarray(rng.uniform(0.1, 0.2)), "half_length": jnp.asarray(rng.uniform(0.1, 0.3))}
        shape = Box(half_size=jnp.asarray(rng.uniform(0.1, 0.2, 3))) if k == 5 else Capsule(**sizes)
        return Collider(
            shape=shape, offset=jnp.asarray(rng.uniform(-0.2, 0.2, 3)), rotation=jnp.asarray(rotations(k, 1)[0]),
            friction=jnp.asarray(rng.uniform(0.1, 0.6)), softness=jnp.asarray(rng.uniform(20.0, 60.0)), body=k % 3,
        )  # fmt: skip

    turns = jnp.asarray(rotations(20, 6))
    before = Pose(jnp.asarray(rng.uniform(-0.1, 0.1, (3, 3))), turns[:3])
    after = Pose(before.position + jnp.asarray(rng.uniform(-2e-3, 2e-3, (3, 3))), turns[:3] + 1e-3 * turns[3:])
    nodes, velocity = (jnp.asarray(rng.uniform(-0.5, 0.5, (300, 3))) for _ in range(2))
    return tuple(map(one, range(10))), nodes, velocity, before, after


def test_long_runs_of_one_kind_act_one_after_the_other(x64, rotations):
    colliders, nodes, velocity, before, after = fingers(rotations)
    assert runs(colliders) == [slice(0, 5), slice(5, 6), slice(6, 10)]
    together = several(colliders, nodes, velocity, before, after, Overlap.SEQUENTIAL)
    one_by_one = velocity
    for c in colliders:
        one_by_one = after_contact(c, nodes, one_by_one, body_pose(before, c.body), body_pose(after, c.body))
    np.testing.assert_allclose(together, one_by_one, atol=1e-13)
    assert np.mean(np.any(together != velocity, axis=1)) > 0.3


def test_derivatives_through_long_runs(x64, rotations, random_like, derivatives_agree):
    colliders, nodes, *others = fingers(rotations)
    args = (colliders, *others)

    def result(args):
        return several(args[0], nodes, *args[1:], Overlap.SEQUENTIAL)

    derivatives_agree(result, args, random_like(1, args), step=1e-8, bar=1e-6, exact=1e-11)


def test_pythons_numbers_in_a_long_run_take_the_type_of_the_velocities(x64):
    nodes, velocity = jnp.ones((2, 3), jnp.float32), -jnp.ones((2, 3), jnp.float32)
    rest = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32)[None], REST)
    balls = tuple(
        Collider(shape=Sphere(radius=2.0), offset=ORIGIN, rotation=EYE, friction=0.1 * k, softness=30.0)
        for k in range(4)
    )
    after = several(balls, nodes, velocity, rest, rest, Overlap.SEQUENTIAL)
    assert after.dtype == jnp.float32 and float(after.min()) > -0.5


def two_boxes(half, apart, friction=0.3):
    """A box on each of two bodies, side by side along x, and random nodes that cover them."""
    boxes = tuple(
        Collider(
            shape=Box(half_size=jnp.asarray(half)),
            offset=ORIGIN,
            rotation=EYE,
            friction=jnp.asarray(friction),
            softness=jnp.asarray(30.0),
            body=b,
        )
        for b in (0, 1)
    )
    rng = np.random.default_rng(3)
    nodes = jnp.asarray(rng.uniform(-0.5, 0.5, (400, 3)))
    velocity = jnp.asarray(rng.standard_normal((400, 3)))
    before = Pose(jnp.array([[-apart, 0.0, 0.0], [apart, 0.0, 0.0]]), jnp.stack([EYE, EYE]))
    return boxes, nodes, velocity, before


def test_nearest_does_not_depend_on_the_order_and_sequential_does(x64):
    boxes, nodes, velocity, before = two_boxes((0.2, 0.2, 0.2), 0.1)  # their tops are equally near inside both
    after = before._replace(position=before.position + jnp.array([[1e-3, 0.0, 0.0], [0.0, -1e-3, 0.0]]))
    results = {
        overlap: [several(b, nodes, velocity, before, after, overlap) for b in (boxes, boxes[::-1])]
        for overlap in Overlap
    }
    np.testing.assert_allclose(*results[Overlap.NEAREST], rtol=1e-13)
    assert np.any(results[Overlap.SEQUENTIAL][0] != results[Overlap.SEQUENTIAL][1])


def test_nearest_is_the_union_of_shapes(x64):
    """Two halves of a box that move together act outside like the box."""
    halves, nodes, velocity, before = two_boxes((0.1, 0.2, 0.2), 0.1)
    whole = halves[0].replace(shape=Box(half_size=jnp.array([0.2, 0.2, 0.2])))
    origin = Pose(jnp.zeros((1, 3)), EYE[None])
    outside = np.any(np.abs(np.asarray(nodes)) > 0.2, axis=1)
    one = several((whole,), nodes, velocity, origin, origin, Overlap.NEAREST)[outside]
    np.testing.assert_allclose(
        several(halves, nodes, velocity, before, before, Overlap.NEAREST)[outside], one, atol=1e-14
    )
    assert np.any(one != velocity[outside])


def test_derivatives_of_nearest_equal_finite_differences(x64, random_like, derivatives_agree):
    boxes, nodes, velocity, before = two_boxes((0.2, 0.2, 0.2), 0.15)
    after = before._replace(position=before.position + jnp.array([[1e-3, 0.0, 0.0], [0.0, -1e-3, 0.0]]))
    boxes = (boxes[0], boxes[1].replace(shape=Box(half_size=jnp.array([0.17, 0.26, 0.13]))))
    args = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), (boxes, velocity, before, after))

    def result(args):
        boxes, velocity, before, after = args
        return several(boxes, nodes, velocity, before, after, Overlap.NEAREST)

    derivatives_agree(result, args, random_like(1, args), step=1e-8, bar=1e-6, exact=1e-11)


def test_shares_of_the_nearest_sum_to_one_in_a_compiled_program():
    """Distances are compared for equality: rounded anew where they are compared, no collider would be nearest."""
    boxes, nodes, _, before = two_boxes((0.2, 0.2, 0.2), 0.1)
    turn = jnp.asarray(np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0], jnp.float32)
    still = Motion(jnp.zeros((3, 3)), jnp.zeros(3))

    @jax.jit
    def shares_and_distance(boxes, nodes, before):
        touches = [
            touch(box, cp.split_vector(nodes), placed(Pose(before.position[box.body], turn), still)) for box in boxes
        ]
        best, shares = nearest(touches)
        return sum(shares), best.distance, jnp.minimum(*(t.distance for t in touches))

    total, distance, least = shares_and_distance(boxes, jnp.asarray(nodes, jnp.float32), before)
    np.testing.assert_array_equal(total, 1.0)
    np.testing.assert_allclose(distance, least, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "stored"),
    [
        (Plane(), [1]),
        (Sphere(radius=0.1), [1]),
        (Capsule(radius=0.1, half_length=0.2), [1]),
        (Box(half_size=jnp.full(3, 0.1)), [3, 4]),
    ],
    ids=["plane", "sphere", "capsule", "box"],
)
def test_on_a_gpu_only_shapes_with_edges_store_places_and_normals(shape, stored):
    """What a barrier holds is stored between kernels. The influence is always: it is compared."""
    collider = Collider(shape=shape, friction=0.5, softness=100.0)
    where = placed(REST, Motion(jnp.zeros((3, 3)), ORIGIN))
    exported = jax.export.export(jax.jit(lambda *p: touch(collider, p, where)), platforms=["cuda"])
    module = exported(*[jax.ShapeDtypeStruct((5,), jnp.float32)] * 3).mlir_module()
    lines = [line for line in module.splitlines() if "stablehlo.optimization_barrier" in line]
    assert [line.count("tensor<") for line in lines] == stored
