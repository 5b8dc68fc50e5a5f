"""The speed up to which self-contact keeps layers apart, and checks of self-contact when a scene is built."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.physics.numerics.checks import Legal, Number, check_numbers
from rewax.physics.thin.contact_elements import ContactElements, smallest_height
from rewax.physics.thin.pair_law import SelfContact, pair_energy
from rewax.physics.thin.stencils import Topology
from rewax.physics.thin.thinmesh import ThinMesh
from rewax.types import Scalar

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


def largest_safe_speed(scene: "ThinScene") -> Scalar:
    """Speed of vertices [m/s] relative to their mean velocity up to which layers do not cross.

    It is the smaller of two limits:
      - sqrt(E / m): a pair at distance 0 stores E, more than the kinetic energy of two vertices of the largest mass m
        that meet at this speed. Vertices that are held or pressed by a heavy collider can exceed it.
      - thickness / (4 dt): in a substep two vertices come closer by at most half of the thickness.

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


def check_self_contact(topology: Topology, mesh: ThinMesh, law: SelfContact | None) -> ContactElements | None:
    """The elements of self-contact, None without it.

    Raises:
      ValueError: an illegal number, a traced thickness, or cloth that is thicker than half of its triangles' height.
    """
    if law is None:
        return None
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
    return ContactElements(topology, vertices, max(float(k) for k in used))


def self_contact_numbers(scene: "ThinScene") -> list[Number]:
    """The numbers of self-contact with their legal values; a thickness above that of the neighbours is illegal."""
    law, elements = scene.self_contact, scene.contact_elements
    if law is None or elements is None:
        return []
    most = (1.0 + 1e-5) * elements.largest_thickness  # the limit may be rounded to float32
    of_cloth, remedy = min(most, (0.5 + 1e-5) * elements.smallest_height), "build the scene with the largest thickness"
    limits = [("thickness", law.thickness, of_cloth)] * (scene.cloth is not None)
    limits += [("rope_thickness", law.rope(), most)] * (scene.rope is not None)
    thicknesses = [Number(f"self_contact.{name}", value, Legal(0.0, limit), remedy) for name, value, limit in limits]
    return [*law.legal_numbers("self_contact"), *thicknesses]


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


__all__ = ["check_max_speed", "check_self_contact", "largest_safe_speed", "self_contact_numbers"]
