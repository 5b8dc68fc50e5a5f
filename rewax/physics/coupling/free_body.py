"""Free rigid bodies: mass properties, motion and conserved quantities.

They serve boxes in water and blocks on dough. Free bodies do not touch each other or the walls; for robots and contact
between rigid bodies use ``rewax.physics.rigid``.
"""

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.physics.contact.motion import Motion
from rewax.physics.numerics.checks import FINITE, POSITIVE, Legal, Number, any_illegal, check_numbers
from rewax.physics.numerics.fields import checked, instance, items, real
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.rotations import normalized, quaternion_to_matrix, skew, turn_quaternion
from rewax.physics.shapes.base import Shape, require_shape
from rewax.physics.shapes.sizes import size_numbers
from rewax.status import Status, all_finite, flag
from rewax.types import Array, Scalar


@struct.dataclass
class Inertia(struct.Replaceable):
    """Mass properties of bodies.

    Attributes:
      mass: mass [kg], shape (num_bodies,), > 0.
      moment: moments and products of inertia about the centre of mass, in the body's frame [kg m^2], shape
        (num_bodies, 3, 3), symmetric and positive definite.
    """

    mass: Array
    moment: Array


@struct.dataclass
class FreeBodies(struct.Replaceable):
    """Motion of bodies. The origin of a body's frame is its centre of mass.

    Attributes:
      position: centre of mass [m], shape (num_bodies, 3).
      orientation: unit quaternion (w, x, y, z) from the body's frame to the world's, shape (num_bodies, 4).
      velocity: velocity of the centre of mass [m/s], shape (num_bodies, 3).
      angular_velocity: angular velocity in the world's frame [rad/s], shape (num_bodies, 3).
    """

    position: Array
    orientation: Array
    velocity: Array
    angular_velocity: Array


INERTIA = instance(Inertia, "give an Inertia(mass=..., moment=...), of inertia_of for example")
_QUATERNIONS = "give unit quaternions (w, x, y, z)"
BODIES = instance(FreeBodies, "give FreeBodies, of bodies_at_rest for example")


@checked(position=real(FINITE, "give centres of mass in metres", shape=("num_bodies", 3)))
def bodies_at_rest(position: Array, orientation: Array | None = None) -> FreeBodies:
    """Bodies with zero velocity.

    Args:
      position: centres of mass [m], shape (num_bodies, 3).
      orientation: unit quaternions (num_bodies, 4); None: the identity. They are normalised.

    Raises:
      ValueError: a position of another shape (one body has shape (1, 3)), a number that is not finite, or a quaternion
        whose length is not 1.

    Gradient: exact.
    """
    position = jnp.asarray(position)
    position = position.astype(jnp.result_type(float, position))
    zeros = jnp.zeros_like(position)
    if orientation is None:
        orientation = jnp.concatenate([jnp.ones_like(zeros[:, :1]), zeros], axis=-1)
    check_numbers([Number("orientation", orientation, FINITE, _QUATERNIONS, (len(position), 4))])
    orientation = jnp.asarray(orientation, position.dtype)
    check_numbers([_lengths(orientation)])
    return FreeBodies(
        position=position, orientation=normalized(orientation), velocity=zeros, angular_velocity=jnp.zeros_like(zeros)
    )


def solid(shape: Shape, density: Scalar) -> tuple[Scalar, Array]:
    """Mass [kg], shape (), and moments of inertia [kg m^2], shape (3, 3), of a homogeneous body.

    Args:
      shape: a bounded shape with its centre of mass at the origin. The result is exact for balls, capsules, boxes,
        cylinders and ellipsoids, and a quadrature for others, see ``Shape.inertia``.
      density: [kg/m^3], > 0.

    Raises:
      ValueError: a shape without bounds, a centre of mass elsewhere, or a density or size that is not positive.

    Gradient: exact.
    """
    density_number = Number("density", density, POSITIVE, "give the body's density in kg/m^3", ())
    check_numbers([density_number, *size_numbers(shape, "shape")])
    return shape.inertia(density)


def inertia_numbers(inertia: Inertia) -> list[Number]:
    """The mass properties of bodies, with their legal values: positive masses, positive definite moments.

    Raises:
      ValueError: known arrays of other shapes, known numbers that are not finite or masses that are not positive.
    """
    given = _given_numbers(inertia)
    check_numbers(given)
    return [*given, *_definite_numbers(inertia)]


@checked(inertia=INERTIA, bodies=BODIES)
def check_status(inertia: Inertia, bodies: FreeBodies) -> Array:
    """Status bits of free bodies (non-finite numbers, orientations that are no unit quaternions) and of their mass
    properties (illegal numbers).

    Steps refuse illegal mass properties that are known; this function reports traced ones, too.

    Args:
      inertia: mass properties of the bodies.
      bodies: the bodies.

    Returns:
      Bits of ``rewax.status.Status``, shape (), int32. Gradient: none.
    """
    inertia, bodies = jax.lax.stop_gradient((inertia, bodies))
    illegal = any_illegal([*_given_numbers(inertia), *_definite_numbers(inertia), _finite_lengths(bodies)])
    return flag(~all_finite(bodies), Status.NAN) | flag(illegal, Status.INVALID_PARAMETERS)


def check_bodies(bodies: FreeBodies) -> None:
    """Raises ValueError for arrays without a row for each body, and known orientations of another length than 1."""
    num_bodies = len(bodies.position)
    for name, width in (("position", 3), ("orientation", 4), ("velocity", 3), ("angular_velocity", 3)):
        shape = jnp.shape(getattr(bodies, name))
        if shape != (num_bodies, width):
            raise ValueError(
                f"bodies.{name} has shape {shape}: give shape ({num_bodies}, {width}), a row for each body (map "
                "batches with jax.vmap)"
            )
    check_numbers([_finite_lengths(bodies)])


def _finite_lengths(bodies: FreeBodies) -> Number:
    """Lengths of the orientations, 1 for those that are not finite: they set ``NAN``."""
    lengths = _lengths(bodies.orientation)
    return lengths._replace(value=jnp.where(jnp.isfinite(lengths.value), lengths.value, 1.0))


def _lengths(orientation: Array) -> Number:
    lengths = jnp.linalg.norm(orientation, axis=-1)
    return Number("the length of orientation", lengths, Legal(1.0 - 1e-3, 1.0 + 1e-3), _QUATERNIONS)


def _given_numbers(inertia: Inertia) -> list[Number]:
    moment = "give moments of inertia in kg m^2"
    return [
        Number("inertia.mass", inertia.mass, POSITIVE, "give masses in kg", ("num_bodies",)),
        Number("inertia.moment", inertia.moment, FINITE, moment, ("num_bodies", 3, 3)),
    ]


def _definite_numbers(inertia: Inertia) -> list[Number]:
    """Numbers that are legal if the moments are symmetric and positive definite."""
    m = jnp.asarray(inertia.moment)
    moments = jnp.diagonal(m, axis1=-2, axis2=-1)
    scale = jnp.max(jnp.abs(m), axis=(-2, -1), keepdims=True)
    m = m / jnp.where(scale > 0, scale, 1.0)  # the determinant of a small body would underflow
    skewed = m - jnp.swapaxes(m, -2, -1)
    minor = m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0]
    volume = jnp.sum(jnp.cross(m[..., 0, :], m[..., 1, :]) * m[..., 2, :], axis=-1)
    definite = "give symmetric, positive definite moments of inertia in kg m^2"
    return [
        Number("the diagonal of inertia.moment", moments, POSITIVE, "give moments of inertia in kg m^2"),
        Number("the relative asymmetry of inertia.moment", skewed, Legal(-1e-4, 1e-4), definite),
        Number("the first minor of inertia.moment", minor, POSITIVE, definite),
        Number("the determinant of inertia.moment", volume, POSITIVE, definite),
    ]


@checked(shapes=items(lambda name, shape: require_shape(shape, name), "give a tuple of shapes"))
def inertia_of(shapes: tuple[Shape, ...], density: Scalar) -> Inertia:
    """Mass properties of several homogeneous bodies, one per shape, from their density [kg/m^3]; see ``solid``.

    Raises:
      ValueError: there are no shapes, or as for ``solid``.

    Gradient: exact with respect to sizes and density.
    """
    if len(shapes) == 0:
        raise ValueError("shapes is empty: give at least one shape")
    masses, moments = zip(*(solid(shape, density) for shape in shapes), strict=True)
    return Inertia(mass=jnp.stack([jnp.asarray(m) for m in masses]), moment=jnp.stack(moments))


def poses(bodies: FreeBodies) -> Pose:
    """Poses of the bodies, shapes (num_bodies, 3), (num_bodies, 3, 3). Gradient: exact."""
    return Pose(bodies.position, quaternion_to_matrix(bodies.orientation))


def motions(bodies: FreeBodies) -> Motion:
    """Velocity fields of the bodies, shapes (num_bodies, 3, 3), (num_bodies, 3). Gradient: exact."""
    turn = skew(bodies.angular_velocity)
    return Motion(turn, bodies.velocity - jnp.einsum("bij,bj->bi", turn, bodies.position, precision="highest"))


def world_moment(bodies: FreeBodies, inertia: Inertia) -> Array:
    """Moments of inertia along the world's axes [kg m^2], shape (num_bodies, 3, 3). Gradient: exact."""
    R = quaternion_to_matrix(bodies.orientation)
    return jnp.einsum("bij,bjk,blk->bil", R, inertia.moment, R, precision="highest")


def push(bodies: FreeBodies, inertia: Inertia, impulse: Array, angular_impulse: Array) -> FreeBodies:
    """Bodies after an impulse.

    Args:
      bodies: bodies before the impulse.
      inertia: their mass properties.
      impulse: change of linear momentum [kg m/s], shape (num_bodies, 3).
      angular_impulse: change of angular momentum about the centre of mass [kg m^2/s], shape (num_bodies, 3).

    Gradient: exact.
    """
    return bodies.replace(
        velocity=bodies.velocity + impulse / inertia.mass[:, None],
        angular_velocity=bodies.angular_velocity + solve3(world_moment(bodies, inertia), angular_impulse),
    )


def move(bodies: FreeBodies, inertia: Inertia, dt: Scalar) -> FreeBodies:
    """Bodies after a time dt [s] without forces, with constant linear and angular momentum. Gradient: exact.

    The moments of inertia rotate with the body, so the angular velocity changes: I' w' = I w. The turn has the angular
    velocity after half of the time. With that at its beginning, a tumbling body would gain energy.
    """
    half = _turned(bodies, inertia, bodies.angular_velocity, 0.5 * dt)
    return _turned(bodies, inertia, half.angular_velocity, dt).replace(position=bodies.position + dt * bodies.velocity)


def _turned(bodies: FreeBodies, inertia: Inertia, angular_velocity: Array, dt: Scalar) -> FreeBodies:
    """Bodies after a turn by ``dt * angular_velocity`` that leaves their angular momentum as it is."""
    turned = bodies.replace(orientation=turn_quaternion(bodies.orientation, angular_velocity, dt))
    moment = world_moment(turned, inertia)
    # Solve for the change: the angular velocity of a body that hardly rotates keeps all its digits.
    lost = _matvec(world_moment(bodies, inertia) - moment, bodies.angular_velocity)
    return turned.replace(angular_velocity=bodies.angular_velocity + solve3(moment, lost))


def momentum(bodies: FreeBodies, inertia: Inertia) -> Array:
    """Linear momentum of all bodies [kg m/s], shape (3,). Gradient: exact."""
    return jnp.sum(inertia.mass[:, None] * bodies.velocity, axis=0)


def angular_momentum(
    bodies: FreeBodies, inertia: Inertia, about: Array | tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Array:
    """Angular momentum of all bodies about a point [kg m^2/s], shape (3,). Gradient: exact."""
    arm = bodies.position - jnp.asarray(about, bodies.position.dtype)
    orbital = inertia.mass[:, None] * jnp.cross(arm, bodies.velocity)
    return jnp.sum(orbital + _matvec(world_moment(bodies, inertia), bodies.angular_velocity), axis=0)


def kinetic_energy(bodies: FreeBodies, inertia: Inertia) -> Array:
    """Kinetic energy of all bodies [J], shape (). Gradient: exact."""
    spin = _matvec(world_moment(bodies, inertia), bodies.angular_velocity)
    linear = jnp.sum(inertia.mass * jnp.sum(bodies.velocity**2, axis=-1))
    return 0.5 * (linear + jnp.sum(bodies.angular_velocity * spin))


def solve3(a: Array, b: Array) -> Array:
    """a^-1 b for symmetric positive definite matrices (..., 3, 3) and vectors (..., 3) or matrices (..., 3, k).

    L D L^T, written out. Batched LAPACK calls cost more than the arithmetic, and cofactors lose all digits of badly
    conditioned matrices. Gradient: exact.
    """
    if b.ndim == a.ndim:
        return jnp.moveaxis(solve3(a[..., None, :, :], jnp.moveaxis(b, -1, -2)), -2, -1)
    d0 = a[..., 0, 0]
    l1, l2 = a[..., 1, 0] / d0, a[..., 2, 0] / d0
    d1 = a[..., 1, 1] - l1 * a[..., 1, 0]
    m = a[..., 2, 1] - l2 * a[..., 1, 0]
    l3 = m / d1
    d2 = a[..., 2, 2] - l2 * a[..., 2, 0] - l3 * m
    y0 = b[..., 0]
    y1 = b[..., 1] - l1 * y0
    z = (b[..., 2] - l2 * y0 - l3 * y1) / d2
    y = y1 / d1 - l3 * z
    return jnp.stack([y0 / d0 - l1 * y - l2 * z, y, z], axis=-1)


def _matvec(a: Array, b: Array) -> Array:
    return jnp.einsum("...ij,...j->...i", a, b, precision="highest")
