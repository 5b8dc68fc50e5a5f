"""``check_shape``: the list of checks of a shape and their order."""

from collections.abc import Callable, Sequence

import jax

from rewax.physics.shapes import Shape
from rewax.testing import shape_derivatives, shape_distance, shape_programs, shape_protocol, shape_rays, shape_solid
from rewax.testing.progress import Progress
from rewax.testing.shape_points import Sample
from rewax.types import Key


def check_shape(
    shape: Shape,
    *,
    key: Key | None = None,
    region: tuple[Sequence[float], Sequence[float]] | None = None,
    tolerance: float = 0.1,
    notify: Callable[[str], None] | None = print,
) -> None:
    """Check a shape against the protocol of ``rewax.physics.shapes.Shape``.

    It checks, in float64 and at points near and far, inside and outside, that

    - the shape is a pytree, and each of its sizes declares its legal range;
    - the normal is the unit gradient of the distance and points outwards;
    - the gradient of the distance has length 1, and point - distance * normal lies on the surface; if ``is_exact`` is
      False, the length is at most 1 near the surface;
    - derivatives agree with finite differences and are finite, also at the center, on axes and at corners, and the
      distance depends on each size;
    - bounding box and radius contain the solid, and the box is tight;
    - volume and inertia agree with those of random points;
    - rays enter the solid where its distance is zero, not later than they meet it, and never from inside;
    - pictures have the extent of the bounding box;
    - ``jit``, ``vmap`` and C++ give the same numbers.

    Args:
      shape: a shape with known sizes.
      key: random key of the points; None: ``jax.random.key(0)``.
      region: lower and upper corner of the box in which points are drawn [m], shape (3,) each; None: the bounding box,
        or from -1 to 1 m for shapes without bounds.
      tolerance: largest error of gradient and normal near the surface if ``is_exact`` is False [-].
      notify: called with a line before each part, and with one if the shape runs in XLA, slower than in C++; None:
        silence.

    Raises:
      AssertionError: a sentence that names what is wrong, and what helps.

    Example:
      >>> check_shape(Box(half_size=(0.1, 0.2, 0.3)))
    """
    say = Progress(f"check_shape {type(shape).__name__}", notify)
    say("sizes")
    shape_protocol.check_protocol(shape)
    sample = Sample(shape, jax.random.key(0) if key is None else key, region)
    say("distance and normal")
    shape_distance.check_values(sample)
    shape_distance.check_normals(sample, tolerance)
    say("derivatives")
    shape_derivatives.check_derivatives(sample)
    if shape.is_bounded:
        say("bounds, volume and inertia")
        shape_solid.check_bounds(sample)
        shape_solid.check_volume(sample)
        shape_solid.check_inertia(sample)
    say("rays and pictures")
    shape_rays.check_rays(sample)
    shape_solid.check_drawings(sample)
    say("jit, vmap and C++")
    for line in shape_programs.check_programs(sample):
        say(line)
    say("passed")


__all__ = ["check_shape"]
