"""The speed up to which self-contact keeps layers apart, and checks of self-contact when a scene is built."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.physics.numerics.checks import check_numbers
from rewax.physics.thin.contact_elements import (
    APART,
    ContactElements,
    mesh_edges,
    near_vertices,
    smallest_height,
)
from rewax.physics.thin.pair_law import SelfContact, pair_energy
from rewax.physics.thin.rest import RestShape
from rewax.physics.thin.stencils import Topology
from rewax.physics.thin.thinmesh import ThinMesh
from rewax.types import Array, Scalar

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


def largest_safe_speed(scene: "ThinScene") -> Scalar:
    """Speed of vertices [m/s] relative to their mean velocity up to which layers do not cross.

    It is the smaller of two limits:

    - sqrt(E / m): a pair at distance 0 stores the energy E. Two vertices of the largest mass m that meet at this speed
      have the kinetic energy E. A vertex that is held, or pressed by a heavy collider, can still pass.
    - thickness / (4 dt): in a substep two vertices come closer by at most half of the thickness.

    Raises:
      ValueError: the scene has no self-contact.

    Gradient: exact.
    """
    law = scene.self_contact
    if law is None:
        raise ValueError("scene has no self_contact: give make_scene a SelfContact(thickness=..., stiffness=...)")
    kinds = [law.thickness] * (scene.cloth is not None) + [law.rope()] * (scene.rope is not None)
    thinnest = jnp.min(jnp.stack([jnp.asarray(k) for k in kinds]))
    stored = pair_energy(law, jnp.zeros_like(thinnest), thinnest)
    mass = scene.mass if scene.mobility is None else jnp.where(scene.mobility > 0, scene.mass, 0.0)
    return jnp.minimum(jnp.sqrt(stored / jnp.max(mass)), thinnest / (4.0 * scene.dt))


@struct.dataclass
class ThicknessLimits(struct.Replaceable):
    """Largest thicknesses for which the neighbours in self-contact are right, over the size of the mesh at rest.

    Attributes:
      cloth: over the root of the area of the cloth [-].
      rope: over the length of all ropes [-].
    """

    cloth: Scalar
    rope: Scalar


def is_too_thick(scene: "ThinScene") -> Array:
    """Whether self-contact is thicker than its neighbours allow, so that elements at rest would repel each other.

    Shape (), bool. Gradient: none.
    """
    law, limits, found = scene.self_contact, scene.thickness_limits, jnp.bool_(False)
    if law is None or limits is None:
        return found
    slack = 1.0 + 1e-5  # a limit may be rounded to float32
    if scene.cloth is not None:
        found |= law.thickness > slack * limits.cloth * jnp.sqrt(jnp.sum(scene.rest.area))
    if scene.rope is not None:
        found |= law.rope() > slack * limits.rope * jnp.sum(scene.rest.length)
    return found


def check_self_contact(
    topology: Topology, mesh: ThinMesh, rest: RestShape, law: SelfContact | None
) -> tuple[ContactElements | None, ThicknessLimits | None]:
    """The elements of self-contact and the thickness for which they are right, None without self-contact.

    Raises:
      ValueError: an illegal number, a traced thickness, or cloth that is thicker than half of its triangles' height.
    """
    if law is None:
        return None, None
    check_numbers(law.legal_numbers("self_contact"))
    if isinstance(law.thickness, Tracer) or isinstance(law.rope(), Tracer):
        raise ValueError(
            "self_contact.thickness is traced, but says which neighbours do not touch: build the scene with the "
            "largest thickness, then scene.replace(self_contact=...)"
        )
    vertices = np.asarray(mesh.vertices, np.float64)
    height = smallest_height(vertices, np.asarray(mesh.triangles))
    if len(mesh.triangles) and 2.0 * float(law.thickness) > height:
        raise ValueError(
            f"self_contact.thickness is {float(law.thickness):g} m, more than half of the smallest height "
            f"{height:.3g} m of a triangle: take thinner cloth or a coarser mesh"
        )
    used = [law.rope()] * bool(len(mesh.segments)) + [law.thickness] * bool(len(mesh.triangles))
    thickness = max(float(k) for k in used)
    near, longer = near_vertices(mesh_edges(topology), vertices, APART * thickness)
    elements = ContactElements(topology, vertices, near)
    of_cloth, of_rope = (
        max(thickness, float(np.min(longer[own], initial=np.inf)) / APART)
        for own in (~elements.in_rope, elements.in_rope)
    )
    area, length = float(np.sum(rest.area)), float(np.sum(rest.length))
    return elements, ThicknessLimits(
        cloth=min(of_cloth, 0.5 * height) / np.sqrt(area) if area else np.inf,
        rope=of_rope / length if length else np.inf,
    )


def check_max_speed(scene: "ThinScene") -> None:
    """Raises ValueError for a ``max_speed`` above the largest safe one. Traced numbers are not checked."""
    law = scene.self_contact
    if law is None:
        return
    limit = largest_safe_speed(scene)
    if not isinstance(limit, Tracer) and not isinstance(law.max_speed, Tracer) and float(law.max_speed) > float(limit):
        raise ValueError(
            f"self_contact.max_speed is {float(law.max_speed):g} m/s, above {float(limit):.3g} m/s, up to which this "
            "self_contact keeps layers apart: take a smaller max_speed, a stiffer or thicker one, or a smaller dt"
        )


__all__ = ["check_max_speed", "check_self_contact", "is_too_thick", "largest_safe_speed"]
