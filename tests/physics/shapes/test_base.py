"""What all shapes have in common: derivatives of the distance, defaults of methods, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from own_shapes import Torus, Union
from shape_cases import ALL, NUM, SAMPLED, TERRAIN, H, R, derivatives, evaluate, points

from rewax import struct
from rewax.lowering.recompute import recomputed
from rewax.physics import shapes as sdf
from rewax.physics.contact.colliders import Collider, apply_collider
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.pose import Pose
from rewax.types import Scalar


def inner(a, b) -> float:
    return sum(float(np.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.parametrize("name", ALL)
def test_derivatives_of_distance_and_normal(x64, random_like, central_difference, relative_error, name):
    """With respect to points and sizes, values, heights: reverse = forward = finite difference; normal = gradient."""
    args = jax.tree.map(lambda a: jnp.asarray(a, float), (ALL[name], points(1)))
    tangents = random_like(2, args)
    cotangents = random_like(3, (jnp.zeros(NUM), jnp.zeros((NUM, 3))))
    forward, reverse = derivatives(args, tangents, cotangents)
    assert relative_error(forward, central_difference(lambda a: evaluate(*a), args, tangents)) < 1e-7
    np.testing.assert_allclose(inner(reverse, tangents), inner(cotangents, forward), rtol=1e-11)
    _, normal = evaluate(*args)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
    if name not in ("sampled", "terrain"):
        slope = central_difference(lambda p: evaluate(args[0], p)[0], args[1], tangents[1])
        np.testing.assert_allclose(slope, np.sum(normal * tangents[1], axis=1), atol=1e-8)


SPECIAL = [0.0, -0.0, 1e-20, R, -R, H, -H, 0.3, 0.5, 0.8, -0.8, -0.6, -0.5, -0.7, -0.15, 1.1, 5.0]


@pytest.mark.parametrize("name", ALL)
@given(seed=hs.integers(0, 10_000))
def test_everything_is_finite_in_the_middle_and_on_edges(x64, name, seed):
    """Centres, axes, corners, tips, nodes and borders of grids: values, forward and reverse derivatives."""
    p = np.random.default_rng(seed).choice(SPECIAL, (NUM, 3))
    p[0], p[1] = 0.0, [0.0, H, 0.0]
    args = jax.tree.map(lambda a: jnp.asarray(a, float), (ALL[name], p))
    ones = jnp.ones(NUM, float), jnp.ones((NUM, 3), float)
    for leaf in jax.tree.leaves((evaluate(*args), derivatives(args, jax.tree.map(jnp.ones_like, args), ones))):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("name", ["ellipsoid", "sampled", "terrain"])
def test_nan_stays_where_it_is(x64, name):
    p = points(4)
    expected = evaluate(ALL[name], p)
    p[5] = np.nan
    got = evaluate(ALL[name], p)
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_array_equal(np.delete(a, 5, axis=0), np.delete(b, 5, axis=0))
    assert np.isnan(got[0][5])


@pytest.mark.parametrize("name", ["ellipsoid", "sampled"])
def test_as_a_collider_under_recomputation_and_vmap(x64, random_like, central_difference, name):
    """The gradients of two environments at once, recomputed, against a finite difference."""
    rng = np.random.default_rng(3)
    nodes, velocity = jnp.asarray(points(2)), jnp.asarray(rng.normal(size=(2, NUM, 3)))
    still = Pose(jnp.zeros(3), jnp.eye(3))
    shapes = jax.tree.map(lambda a: jnp.stack([jnp.asarray(a), 1.1 * a]), ALL[name])

    def change(shape, velocity):
        collider = Collider(shape=shape, offset=jnp.zeros(3), rotation=jnp.eye(3), friction=0.4, softness=8.0)
        v = apply_collider(collider, cp.split_vector(nodes), cp.split_vector(velocity), still, still, 1e-3)
        return jnp.sum((cp.join_vector(v) - velocity) ** 2)

    loss = jax.jit(jax.vmap(recomputed(change)))
    args = shapes, velocity
    gradient = jax.jit(jax.grad(lambda *a: jnp.sum(loss(*a)), (0, 1)))(*args)
    for leaf in jax.tree.leaves(gradient[0]):
        assert np.all(np.any(leaf.reshape(2, -1) != 0, axis=1))
    direction = random_like(4, args)
    difference = central_difference(lambda a: loss(*a), args, direction, 1e-7)
    for lane in range(2):
        got = inner(*jax.tree.map(lambda a, i=lane: a[i], (gradient, direction)))
        np.testing.assert_allclose(got, difference[lane], rtol=1e-5)


PLAIN = {
    "sphere": (sdf.Sphere, {"radius": 0.4}),
    "capsule": (sdf.Capsule, {"radius": 0.4, "half_length": 1}),
    "box": (sdf.Box, {"half_size": (0.3, 0.5, 1)}),
    "cylinder": (sdf.Cylinder, {"radius": 0.4, "half_length": 1}),
    "cone": (sdf.Cone, {"radius": 0.4, "half_length": 1}),
    "ellipsoid": (sdf.Ellipsoid, {"semi_axes": [0.3, 0.5, 1]}),
    "sampled": (
        sdf.SampledDistance,
        {"values": [[[0, 1], [0, 0]], [[0, 0], [1, -1]]], "origin": (0, 0, 0), "spacing": 1},
    ),
    "terrain": (sdf.HeightField, {"heights": [[0, 1], [2, -1]], "origin": (0, -1), "spacing": 1}),
    "torus": (Torus, {"ring": 1, "tube": 0.2}),
}


@pytest.mark.parametrize("name", PLAIN)
@given(seed=hs.integers(0, 10_000))
def test_plain_numbers_have_derivatives(name, seed):
    """Each component of each field, given as Python numbers, moves the distances of random points."""
    kind, numbers = PLAIN[name]
    p = jnp.asarray(np.random.default_rng(seed).uniform(-1.5, 1.5, (256, 3)), jnp.float32)
    by_sizes = total_by_sizes(kind(**numbers), p)
    assert set(vars(by_sizes)) == set(numbers)
    for field, value in vars(by_sizes).items():
        assert value.shape == np.shape(numbers[field]) and np.isfinite(value).all() and np.all(value != 0), field


@jax.jit
def total_by_sizes(shape, p):
    """Weighed, so that what one point gains is not what another one loses."""
    weights = 1.0 + jnp.arange(len(p)) / len(p)
    return jax.grad(lambda shape: jnp.sum(weights * sdf.signed_distance(shape, p)[0]))(shape)


def test_a_shape_of_two_methods_has_all_others(x64):
    """Volume, moments and reach of a torus (Pappus), with derivatives by both radii."""
    R, r = 0.3, 0.1
    torus = Torus(ring=R, tube=r)
    volume, by_sizes = jax.value_and_grad(sdf.volume)(torus)
    np.testing.assert_allclose(volume, 2 * np.pi**2 * R * r**2, rtol=2e-3)
    np.testing.assert_allclose([by_sizes.ring, by_sizes.tube], 2 * np.pi**2 * np.array([r**2, 2 * R * r]), rtol=5e-3)
    mass, moment = torus.inertia(700.0)
    np.testing.assert_allclose(mass, 700.0 * volume, rtol=1e-12)
    across = R**2 / 2 + 5 * r**2 / 8
    np.testing.assert_allclose(
        moment / mass, np.diag([across, R**2 + 3 * r**2 / 4, across]), rtol=2e-3, atol=1e-3 * across
    )
    assert R + r < torus.bounding_radius() < 1.5 * (R + r)


def test_parts_move_and_bound_a_shape_that_is_made_of_them():
    both = Union(first=Torus(ring=0.3, tube=0.1), second=sdf.Sphere(radius=0.15))
    np.testing.assert_allclose(sdf.bounding_box(both)[1], [0.4, 0.15, 0.4], rtol=1e-6)
    np.testing.assert_allclose(both.volume(), both.first.volume() + both.second.volume(), rtol=5e-3)
    d, n = sdf.signed_distance(both, jnp.array([[0.0, 0.0, 0.0], [0.3, 0.05, 0.0], [0.0, 0.5, 0.0]]))
    np.testing.assert_allclose(d, [-0.15, -0.05, 0.35], atol=1e-6)
    np.testing.assert_allclose(n[1:], [[0.0, 1.0, 0.0]] * 2, atol=1e-6)


@struct.dataclass
class Wavy(sdf.Shape):
    """Bounded by a ball."""

    radius: Scalar = struct.number(POSITIVE, "give a length in metres")

    def bounding_radius(self):
        return self.radius


@struct.dataclass
class Slab(sdf.Shape):
    """Unbounded."""

    def distance(self, p):
        zero = jnp.zeros_like(p[1])
        return jnp.abs(p[1]) - 0.1, (zero, jnp.sign(p[1]), zero)


def test_bounds_follow_from_each_other():
    np.testing.assert_array_equal(sdf.bounding_box(Wavy(radius=0.5)), [[-0.5] * 3, [0.5] * 3])
    assert Slab().bounding_radius() == np.inf and not Slab().is_bounded and Slab().draw() == []
    with pytest.raises(ValueError, match=r"^shape is a Slab, .* write the method bounding_box\(self\) of Slab$"):
        sdf.volume(Slab())
    with pytest.raises(ValueError, match=r"call bounding_box before jit, or use shape\.bounding_box"):
        jax.jit(lambda shape: sdf.bounding_box(shape)[0])(Wavy(radius=0.5))


def test_bounding_boxes_and_fillings_are_known_while_a_program_is_traced():
    ball = Torus(ring=0.3, tube=0.1)
    count = []
    jax.jit(lambda x: count.append((len(sdf.fill(ball, 0.05)), *sdf.bounding_box(ball)[1])) or x)(0.0)
    np.testing.assert_allclose(count, [(len(sdf.fill(ball, 0.05)), 0.4, 0.1, 0.4)], rtol=1e-6)


def test_something_else_is_refused():
    sentence = r"^shape is .ball.: give a shape of rewax\.physics\.shapes, or of a class derived from Shape$"
    for function in (sdf.volume, sdf.bounding_box, lambda shape: sdf.fill(shape, 0.1)):
        with pytest.raises(ValueError, match=sentence):
            function("ball")
    with pytest.raises(ValueError, match=sentence):
        sdf.signed_distance("ball", jnp.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"^Wavy has no distance: write its method distance\(self, p\)$"):
        sdf.signed_distance(Wavy(radius=1.0), jnp.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"SampledDistance.values has shape \(1, 3, 5\): give at least two nodes"):
        sdf.signed_distance(SAMPLED.replace(values=np.zeros((1, 3, 5))), jnp.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"HeightField.heights has shape \(4,\)"):
        sdf.signed_distance(TERRAIN.replace(heights=np.zeros(4)), jnp.zeros((1, 3)))
