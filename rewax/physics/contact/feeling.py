"""The scan over the substeps of a solver whose bodies feel contact."""

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import jax

from rewax.physics.contact.patches import accumulated, check_patches, no_touch
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.substeps import check_has_substeps, scan_substeps
from rewax.types import Scalar

S = TypeVar("S")


class Feeling(NamedTuple, Generic[S]):
    """Carry of the scan over substeps."""

    soft: S
    """State of the solver."""
    received: Any
    """Sums over the substeps of force or impulse, and torque, on each patch."""

    def after(self, soft: S, received: Any) -> "Feeling[S]":
        """After a substep in which the patches received ``received``."""
        return Feeling(soft, accumulated(self.received, received))


def scan_touch(
    substep: Callable[[Feeling[S], Any], Feeling[S]],
    soft: S,
    intervals: Any,
    poses: Pose,
    patches: Any,
    *,
    store_every: int | None,
    dt: Scalar | int = 1,
) -> tuple[S, Any]:
    """All substeps, and the mean force and torque on each patch.

    Args:
      substep: one substep, ``recomputed`` unless ``store_every`` is None.
      soft: state of the solver.
      intervals, store_every: see ``scan_substeps``.
      poses: of all bodies at the boundaries of the substeps, shapes (num_substeps + 1, num_bodies, ...).
      patches: ``Patches``, or a tree of them.
      dt: duration of a substep [s], if patches receive impulses; 1 if they receive forces.

    Returns:
      The state after the substeps. Force [N] and torque [N m] on each patch, averaged over the substeps.

    Gradient: exact.

    Raises:
      ValueError: a patch belongs to a body that has no pose.
    """
    num_substeps, num_bodies = poses.position.shape[0] - 1, poses.position.shape[1]
    check_has_substeps(num_substeps)
    check_patches(patches, num_bodies)
    start = Feeling(soft, no_touch(patches, jax.tree.leaves(soft)[0]))
    end = scan_substeps(substep, start, intervals, store_every)
    return end.soft, jax.tree.map(lambda a: a / (num_substeps * dt), end.received)


__all__ = ["Feeling", "scan_touch"]
