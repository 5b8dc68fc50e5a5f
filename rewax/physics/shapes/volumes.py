"""Volumes and bounding boxes of shapes."""

import jax
import numpy as np
from jax.core import Tracer

from rewax.physics.shapes.base import Shape
from rewax.physics.shapes.sizes import check_sizes
from rewax.physics.shapes.solid import corners_of
from rewax.types import Scalar


def volume(shape: Shape) -> Scalar:
    """Volume of a shape [m^3], ``shape.volume()``; particles that fill it have volume / num_particles each.

    Raises:
      ValueError: the shape has no bounds, or is no ``Shape``.

    Gradient: exact for the value that the shape's method computes.
    """
    check_sizes("shape", shape)
    return shape.volume()


def bounding_box(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest coordinates of a shape in its own frame [m], float64 of shape (3,) each.

    Inside compiled programs use ``shape.bounding_box()``, which returns JAX arrays.

    Raises:
      ValueError: the shape has no bounds, or is no ``Shape``; its sizes are traced; a ``SampledDistance`` is nowhere
        negative; the method returns no finite corners, the upper above the lower.

    Gradient: none.
    """
    check_sizes("shape", shape)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(shape)):
        raise ValueError("the sizes of shape are traced: call bounding_box before jit, or use shape.bounding_box()")
    with jax.ensure_compile_time_eval():
        lower, upper = (np.asarray(corner, np.float64) for corner in corners_of(shape))
    if not (np.isfinite(lower) & np.isfinite(upper) & (lower < upper)).all():
        raise ValueError(
            f"the bounding box of {type(shape).__name__} reaches from {_shown(lower)} to {_shown(upper)}: its upper "
            "corner must be above the lower one along each axis, and both finite"
        )
    return lower, upper


def _shown(corner: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in corner.ravel()) + ")"


__all__ = ["bounding_box", "volume"]
