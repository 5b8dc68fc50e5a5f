"""Inputs of a step of cloth and ropes beside the bodies' motion: pins of held vertices, grips of grasps."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from rewax.physics.thin.grasps import checked_grips
from rewax.physics.thin.scene import ThinScene, ThinState, check_vertices
from rewax.types import Array


class Prescribed(NamedTuple):
    """Pins and grips of one substep, or with a leading axis of several."""

    pins: Array | None = None
    """Positions of the held vertices at the end [m], (num_held, 3)."""
    grips: Array | None = None
    """Grips of the grasps, (num_grasps,)."""


NOTHING_PRESCRIBED = Prescribed()


def checked_prescribed(
    scene: ThinScene, state: ThinState, pins: Any, grips: Any, num_substeps: int, num_bodies: int
) -> Prescribed:
    """Pins and grips of every substep. Raises ValueError for those, or a state, of another shape, see ``step``."""
    check_vertices(scene, state)
    want = (num_substeps, len(scene.topology.held), 3)
    pins = None if pins is None else jnp.asarray(pins, state.x.dtype)
    if pins is not None and (jnp.shape(pins) != want or not want[1]):
        raise ValueError(
            f"pins has shape {jnp.shape(pins)}, but the scene has {want[1]} held vertices and poses {want[0]} substeps"
            f": give shape {want}, and make_scene the vertices to be held"
        )
    return Prescribed(pins, checked_grips(scene, state.holds, grips, num_substeps, num_bodies))


__all__ = ["NOTHING_PRESCRIBED", "Prescribed", "checked_prescribed"]
