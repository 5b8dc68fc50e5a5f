"""Free rigid bodies alone: what they conserve, and the mass of solids."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_shapes import Torus

from rewax.physics.coupling import free_body
from rewax.physics.numerics.checks import check_numbers
from rewax.physics.shapes import Box, Capsule, Cone, Cylinder, Ellipsoid, Plane, Sphere, signed_distance
from rewax.physics.shapes.sampling import fill_box
from rewax.status import Status

BOX = Box(half_size=jnp.array([0.03, 0.02, 0.03]))


@pytest.mark.parametrize(
    "shape",
    [
        BOX,
        Sphere(radius=0.2),
        Cylinder(radius=0.1, half_length=0.3),
        Capsule(radius=0.1, half_length=0.2),
        Ellipsoid(semi_axes=(0.1, 0.2, 0.1)),
        Torus(ring=0.07, tube=0.03),
    ],
    ids=lambda s: type(s).__name__,
)
def test_mass_and_inertia_of_solids(shape):
    """Against sums over many points inside."""
    size = np.array(
        {Box: (0.06, 0.04, 0.06), Sphere: (0.4, 0.4, 0.4), Torus: (0.2, 0.06, 0.2)}.get(type(shape), (0.2, 0.62, 0.2))
    )
    points = fill_box((0.0, 0.0, 0.0), size, size.min() / 60)
    volume = np.prod(size) / len(points)
    points = points[np.asarray(signed_distance(shape, jnp.asarray(points))[0]) < 0]
    mass = 700.0 * volume * len(points)
    square = np.einsum("ni,ni->n", points, points)
    moment = mass * (np.mean(square) * np.eye(3) - points.T @ points / len(points))
    got = free_body.solid(shape, 700.0)
    np.testing.assert_allclose(got[0], mass, rtol=5e-3)
    np.testing.assert_allclose(got[1], moment, atol=1e-2 * moment.max())


@pytest.mark.parametrize("moments", [(1.0, 1.0, 1.0), (1.0, 2.0, 2.9), (1e-3, 1.7, 1.7)], ids=["cube", "brick", "rod"])
def test_a_body_without_forces_keeps_its_angular_momentum(rotations, moments):
    """Over 1000 times dt, in float32, also a slender one whose moments differ by 1700."""
    turn = rotations(0, 1)[0]
    inertia = free_body.Inertia(
        mass=jnp.ones(1), moment=jnp.asarray(turn @ np.diag(moments) @ turn.T, jnp.float32)[None]
    )
    bodies = free_body.bodies_at_rest([[1.0, 2.0, 3.0]]).replace(angular_velocity=jnp.array([[1.0, -2.0, 0.5]]))

    @jax.jit
    def thousand(bodies):
        return jax.lax.scan(lambda b, _: (free_body.move(b, inertia, 2e-4), None), bodies, length=1000)[0]

    def spin(bodies):
        return np.asarray(free_body.angular_momentum(bodies, inertia, bodies.position[0]), np.float64)

    after = thousand(bodies)
    assert np.linalg.norm(spin(after) - spin(bodies)) < 2e-5 * np.linalg.norm(spin(bodies))
    assert np.linalg.norm(after.angular_velocity) > 0.5


def test_a_tumbling_body_keeps_its_energy(x64):
    """Five seconds at 20 rad/s around the unstable axis."""
    inertia = free_body.inertia_of((Box(half_size=jnp.array([0.1, 0.05, 0.02])),), density=500.0)
    bodies = free_body.bodies_at_rest([[0.0, 0.0, 0.0]]).replace(angular_velocity=jnp.array([[2.0, 20.0, 2.0]]))
    energies = jax.jit(
        lambda b: jax.lax.scan(
            lambda b, _: (free_body.move(b, inertia, 1e-3), free_body.kinetic_energy(b, inertia)), b, length=5000
        )[1]
    )(bodies)
    np.testing.assert_allclose(energies, energies[0], rtol=2e-3)


@pytest.mark.parametrize("ratio", [1.0, 1e3, 1e5])
def test_equations_of_badly_conditioned_matrices(rotations, ratio):
    """1 + ratio n n^T, as contact of a light body makes it: the error stays near rounding times the condition."""
    n = rotations(1, 50)[:, 0]
    a = np.eye(3) + ratio * n[:, :, None] * n[:, None, :]
    x = np.random.default_rng(0).standard_normal((50, 3))
    b = np.einsum("nij,nj->ni", a, x)
    got = free_body.solve3(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32))
    assert np.abs(got - x).max() < 2e-6 * (1.0 + ratio)
    many = free_body.solve3(jnp.asarray(a, jnp.float32), jnp.asarray(np.stack([b, 2 * b], -1), jnp.float32))
    for column, factor in ((0, 1.0), (1, 2.0)):
        assert np.abs(many[..., column] - factor * x).max() < 4e-6 * (1.0 + ratio)


def test_integers_become_floats():
    bodies = free_body.bodies_at_rest([[0, 1, 0]], jnp.array([[1, 0, 0, 0]]))
    assert {leaf.dtype for leaf in jax.tree.leaves(bodies)} == {np.dtype(np.float32)}


@pytest.mark.parametrize(
    ("shape", "sentence"),
    [
        (
            Cone(radius=0.1, half_length=0.2),
            r"^the centre of mass of the Cone is \(.*, -0\.(1|0999), .*\), but must be the origin",
        ),
        (Plane(), "^shape is a Plane, which has no bounds"),
        (Sphere(radius=-0.1), r"^shape\.radius is -0\.1"),
        ("ball", "^shape is 'ball': give a shape"),
    ],
)
def test_solids_without_moments_are_refused(shape, sentence):
    with pytest.raises(ValueError, match=sentence):
        free_body.solid(shape, 700.0)


def test_orientations_have_length_one():
    still = free_body.bodies_at_rest([[0.0, 0.0, 0.0]], [[0.6, 0.8005, 0.0, 0.0]])
    np.testing.assert_allclose(jnp.linalg.norm(still.orientation), 1.0, rtol=1e-6)
    for wrong in ([1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]):
        with pytest.raises(ValueError, match=r"the length of orientation\[0\] is .*: give unit quaternions"):
            free_body.bodies_at_rest([[0.0, 0.0, 0.0]], [wrong])


def test_a_grain_has_a_legal_moment_of_inertia():
    """A cube of a tenth of a millimetre: the determinant of its moment is below the smallest float32."""
    grain = free_body.inertia_of((Box(half_size=jnp.full(3, 5e-5)),), density=1000.0)
    check_numbers(free_body.inertia_numbers(grain))


@pytest.mark.parametrize(
    ("moment", "what"),
    [
        ([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "first minor"),
        ([[1.0, 0.0, 0.9], [0.0, 1.0, 0.9], [0.9, 0.9, 1.0]], "determinant"),
        ([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "relative asymmetry"),
    ],
)
def test_moments_of_inertia_are_positive_definite(moment, what):
    inertia = free_body.Inertia(mass=jnp.ones(1), moment=1e-3 * jnp.asarray([moment]))
    with pytest.raises(ValueError, match=f"the {what} of inertia.moment.*: give symmetric, positive definite moments"):
        check_numbers(free_body.inertia_numbers(inertia))


@pytest.mark.parametrize(
    ("mass", "moment", "position", "status"),
    [
        (1.0, np.eye(3), 0.0, Status.OK),
        (-1.0, np.eye(3), 0.0, Status.INVALID_PARAMETERS),
        (np.nan, np.eye(3), 0.0, Status.INVALID_PARAMETERS),
        (1.0, np.diag([1.0, -1.0, 1.0]), 0.0, Status.INVALID_PARAMETERS),
        (1.0, np.eye(3) + 0.1 * np.eye(3, k=1), 0.0, Status.INVALID_PARAMETERS),
        (1.0, np.eye(3), np.inf, Status.NAN),
        (0.0, np.eye(3), np.nan, Status.NAN | Status.INVALID_PARAMETERS),
    ],
)
def test_the_status_reports_what_steps_refuse_when_it_is_known(mass, moment, position, status):
    inertia = free_body.Inertia(mass=jnp.array([mass, 1.0]), moment=jnp.stack([jnp.asarray(moment), jnp.eye(3)]))
    bodies = free_body.bodies_at_rest(jnp.zeros((2, 3)))
    bodies = bodies.replace(position=bodies.position.at[0, 1].set(position))
    for check in (free_body.check_status, jax.jit(free_body.check_status)):
        assert int(check(inertia, bodies)) == status


def test_bodies_of_other_shapes_or_orientations_are_refused():
    bodies = free_body.bodies_at_rest(jnp.zeros((2, 3)))
    free_body.check_bodies(bodies)
    free_body.check_bodies(bodies.replace(orientation=bodies.orientation.at[0].set(jnp.nan)))  # sets NAN
    for name, value, sentence in (
        (
            "orientation",
            [[1.0, 1.0, 0, 0], [1.0, 0, 0, 0]],
            "the length of orientation.* is 1.41.* give unit quaternions",
        ),
        ("orientation", [[1.0, 0, 0, 0]], r"bodies.orientation has shape \(1, 4\): give shape \(2, 4\)"),
        ("velocity", [0.0, 0, 0], r"bodies.velocity has shape \(3,\): give shape \(2, 3\)"),
    ):
        with pytest.raises(ValueError, match=sentence):
            free_body.check_bodies(bodies.replace(**{name: jnp.array(value)}))


@pytest.mark.parametrize(
    ("orientation", "status"),
    [
        ([0.6, 0.0, 0.8, 0.0], Status.OK),
        ([1.0, 0.0, 0.1, 0.0], Status.INVALID_PARAMETERS),
        ([0.0, 0.0, 0.0, 0.0], Status.INVALID_PARAMETERS),
        ([np.nan, 0.0, 0.0, 0.0], Status.NAN),
    ],
)
def test_the_status_reports_an_orientation_that_is_no_unit_quaternion(orientation, status):
    inertia = free_body.Inertia(mass=jnp.ones(2), moment=jnp.stack([jnp.eye(3)] * 2))
    bodies = free_body.bodies_at_rest(jnp.zeros((2, 3)))
    bodies = bodies.replace(orientation=bodies.orientation.at[1].set(jnp.asarray(orientation)))
    for check in (free_body.check_status, jax.jit(free_body.check_status)):
        assert int(check(inertia, bodies)) == status
