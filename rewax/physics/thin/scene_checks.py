"""Checks of the parts of a scene of cloth and ropes."""

from typing import Any

import numpy as np
from jax.core import Tracer

from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.contact_checks import penalty_numbers
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.contact.vertex_checks import check_length, contact_numbers, gravity_number
from rewax.physics.numerics.checks import NOT_NEGATIVE, Number, numbers_of
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin.implicit import Implicit
from rewax.physics.thin.materials import BendingLaw, Cloth, MembraneLaw, Rope
from rewax.physics.thin.stencils import Topology
from rewax.types import Array


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
        gravity_number(gravity),
        *contact_numbers(contact, ground, colliders, poses),
    ]


def check_lengths(
    topology: Topology, cloth: Cloth | None, rope: Rope | None, contact: PenaltyContact | None, law: BendingLaw
) -> None:
    """Raises ValueError for parameters that are neither numbers nor one per element."""
    for part, name, count in ((cloth, "cloth.", topology.triangles), (rope, "rope.", topology.segments)):
        for number in [] if part is None else numbers_of(part, name):
            at = topology.bends if part is rope else topology.hinges if law is BendingLaw.HINGES else count
            if number.name == "cloth.yield_curvature":
                at = topology.hinges
            own = number.name.endswith("bending") or number.name == "cloth.yield_curvature"
            check_length(number, len(at if own else count))
    for number in [] if contact is None else penalty_numbers(contact):
        check_length(number, topology.triangles.num_vertices)


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
    if np.any(law_does_not_fit(law, cloth)):
        raise ValueError(
            "law is NEO_HOOKEAN, which is isotropic, but cloth.warp or cloth.weft is not coupling + 2 shear: take "
            "thin.isotropic_cloth, or SAINT_VENANT_KIRCHHOFF"
        )


def check_stepper(stepper: Implicit | None, contact: PenaltyContact | None, grasps: tuple) -> None:
    """Raises ValueError for implicit steps with grasps, or with a normal force that jumps. Traced numbers are not
    checked."""
    if stepper is not None and grasps:
        raise ValueError("stepper is a thin.Implicit, but the scene has grasps, which need explicit steps: take None")
    if stepper is None or contact is None or isinstance(contact.damping, Tracer) or isinstance(contact.onset, Tracer):
        return
    if np.any((np.asarray(contact.damping) > 0) & ~(np.asarray(contact.onset) > 0)):
        raise ValueError(
            "contact.damping is positive and contact.onset is 0, so that the force jumps where a vertex touches and an "
            "implicit step may have no solution: give contact.onset a depth in m, or take depth_damping"
        )


def check_can_couple(stepper: Implicit | None, cloth: Cloth | None) -> None:
    """Raises ValueError for implicit steps and for cloth that yields: a coupled step has neither."""
    if stepper is not None:
        raise ValueError("stepper is a thin.Implicit, but coupled bodies take explicit steps: make the scene without")
    if cloth is not None and cloth.yield_curvature is not None:
        raise ValueError(
            "cloth.yield_curvature is given, but cloth that is coupled with bodies or particles cannot keep creases: "
            "take None"
        )


def check_creases(cloth: Cloth | None, topology: Topology, crease: Array | None) -> None:
    """Raises ValueError for a state that has creases although the cloth does not yield, or none although it does."""
    yields = cloth is not None and cloth.yield_curvature is not None
    if yields and crease is None:
        raise ValueError("state.crease is None, but the cloth yields: begin with thin.no_creases(scene, state)")
    if crease is not None and not yields:
        raise ValueError("state.crease is given, but the cloth does not yield: take state.replace(crease=None)")
    if crease is not None and crease.shape != (len(topology.hinges),):
        raise ValueError(f"state.crease has shape {crease.shape}: give shape ({len(topology.hinges)},)")


def law_does_not_fit(law: MembraneLaw, cloth: Cloth) -> Any:
    """Whether the law is neo-Hookean, but the material not isotropic. Gradient: none."""
    if law is not MembraneLaw.NEO_HOOKEAN:
        return np.False_
    stiffness = cloth.coupling + 2.0 * cloth.shear
    return (abs(cloth.warp - stiffness) > 1e-4 * stiffness) | (abs(cloth.weft - stiffness) > 1e-4 * stiffness)


def cloth_is_unstable(cloth: Cloth) -> Any:
    """Whether a strain of the membrane has no positive energy. Gradient: none."""
    return cloth.coupling**2 >= cloth.warp * cloth.weft


__all__ = ["check_can_couple", "check_creases", "check_lengths", "check_materials", "check_stepper",
           "cloth_is_unstable", "law_does_not_fit", "scene_numbers"]  # fmt: skip
