"""The speed up to which self-contact keeps layers apart, and checks of self-contact when a scene is built."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.physics.numerics.checks import check_numbers, numbers_of
from rewax.physics.thin.contact_elements import ContactElements
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
    check_numbers(numbers_of(law, "self_contact."))
    if isinstance(law.thickness, Tracer) or isinstance(law.rope(), Tracer):
        raise ValueError(
            "self_contact.thickness is traced, but says which neighbours do not touch: build the scene with a number, "
            "then scene.replace(self_contact=...)"
        )
    vertices = np.asarray(mesh.vertices, np.float64)
    if len(mesh.triangles):
        corners = vertices[np.asarray(mesh.triangles)]
        sides = [np.linalg.norm(corners[:, k] - corners[:, k - 1], axis=-1) for k in range(3)]
        twice = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
        height = float(np.min(twice / np.max(sides, axis=0)))
        if 2.0 * float(law.thickness) > height:
            raise ValueError(
                f"self_contact.thickness is {float(law.thickness):g} m, more than half of the smallest height "
                f"{height:.3g} m of a triangle: take thinner cloth or a coarser mesh"
            )
    used = [law.rope()] * bool(len(mesh.segments)) + [law.thickness] * bool(len(mesh.triangles))
    return ContactElements(topology, vertices, max(float(k) for k in used))


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


__all__ = ["check_max_speed", "check_self_contact", "largest_safe_speed"]
