"""Checks of the parts of a scene of cloth and ropes."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.contact_checks import collider_numbers, ground_numbers, penalty_numbers
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.checks import FINITE, GRAVITY, NOT_NEGATIVE, Number, numbers_of
from rewax.physics.numerics.fields import check_range
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin.materials import Cloth, MembraneLaw, Rope
from rewax.physics.thin.stencils import Topology


def scene_numbers(
    cloth: Cloth | None,
    rope: Rope | None,
    drag: Any,
    gravity: Any,
    contact: PenaltyContact | None,
    ground: Ground | None,
    colliders: tuple[Collider, ...],
    poses: Pose | None = None,
) -> list[Number]:
    """The numbers of a scene, with their legal values."""
    return [
        *([] if cloth is None else numbers_of(cloth, "cloth.")),
        *([] if rope is None else numbers_of(rope, "rope.")),
        Number("drag", drag, NOT_NEGATIVE, "give a rate in 1/s, 0 for none", ()),
        Number("gravity", gravity, FINITE, GRAVITY, (3,)),
        *([] if contact is None else penalty_numbers(contact)),
        *([] if ground is None else ground_numbers(ground)),
        *collider_numbers(colliders, poses),
    ]


def check_lengths(topology: Topology, cloth: Cloth | None, rope: Rope | None, contact: PenaltyContact | None) -> None:
    """Raises ValueError for parameters that are neither numbers nor one per element."""
    for part, name, count in ((cloth, "cloth.", topology.triangles), (rope, "rope.", topology.segments)):
        for number in [] if part is None else numbers_of(part, name):
            hinged = topology.hinges if part is cloth else topology.bends
            _check_length(number, len(hinged if number.name.endswith("bending") else count))
    for number in [] if contact is None else penalty_numbers(contact):
        _check_length(number, topology.triangles.num_vertices)


def _check_length(number: Number, length: int) -> None:
    shape = jnp.shape(number.value)
    if shape not in ((), (length,)):
        raise ValueError(f"{number.name} has shape {shape}: give a number or an array of shape ({length},)")


def check_materials(topology: Topology, cloth: Cloth | None, rope: Rope | None, law: MembraneLaw) -> None:
    """Raises ValueError for elements without a material, materials without elements, and unstable membranes."""
    for name, part, elements in (("cloth", cloth, topology.triangles), ("rope", rope, topology.segments)):
        kind = "triangles" if name == "cloth" else "segments"
        if (part is not None) != (len(elements) > 0):
            raise ValueError(
                f"{name} is {'given' if part is not None else 'None'}, but the mesh has {len(elements)} {kind}: give a "
                f"{name} exactly if the mesh has {kind}"
            )
    if cloth is None or any(isinstance(a, Tracer) for a in (cloth.warp, cloth.weft, cloth.coupling, cloth.shear)):
        return
    if np.any(cloth_is_unstable(cloth)):
        raise ValueError("cloth.coupling is at least sqrt(warp weft), where stretch costs no energy: take less")
    pressure = cloth.coupling + 2.0 * cloth.shear
    if law is MembraneLaw.NEO_HOOKEAN and not (
        np.allclose(cloth.warp, pressure, rtol=1e-4) and np.allclose(cloth.weft, pressure, rtol=1e-4)
    ):
        raise ValueError(
            "law is NEO_HOOKEAN, which is isotropic, but cloth.warp or cloth.weft is not coupling + 2 shear: take "
            "thin.isotropic_cloth, or SAINT_VENANT_KIRCHHOFF"
        )


def cloth_is_unstable(cloth: Cloth) -> Any:
    """Whether a strain of the membrane has no positive energy. Gradient: none."""
    return cloth.coupling**2 >= cloth.warp * cloth.weft


def held_indices(held: Any, num_vertices: int) -> np.ndarray:
    """Indices of held vertices, in the order given, from indices or a mask."""
    try:
        held = np.asarray(held)
    except ValueError:  # rows of several lengths
        held = np.asarray(None)
    if held.size == 0:
        return np.zeros(0, int)
    if held.dtype == bool and held.shape == (num_vertices,):
        return np.flatnonzero(held)
    if held.ndim != 1 or not np.issubdtype(held.dtype, np.integer) or len(np.unique(held)) < len(held):
        raise ValueError(
            f"held is an array of {held.dtype} of shape {held.shape}: give different indices of vertices, or a mask of "
            f"shape ({num_vertices},)"
        )
    check_range("held", held, num_vertices)
    return held


__all__ = ["check_lengths", "check_materials", "cloth_is_unstable", "held_indices", "scene_numbers"]
