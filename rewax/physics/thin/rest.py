"""The rest shape of cloth and ropes, as a differentiable function of a mesh."""

from typing import Any

import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.thin.elements import hinge_angle
from rewax.physics.thin.materials import Cloth, Rope
from rewax.physics.thin.plate import PlateRest, plate_rest
from rewax.physics.thin.stencils import Topology
from rewax.types import Array


@struct.dataclass
class RestShape(struct.Replaceable):
    """Sizes of all elements at rest.

    Attributes:
      inverse_edges: inverse of each triangle's edge matrix in its plane, whose rows are warp and weft [1/m], shape
        (num_triangles, 2, 2).
      area: of triangles [m^2], shape (num_triangles,).
      angle: of hinges [rad], shape (num_hinges,).
      hinge_weight: edge squared over the area of both triangles [-], shape (num_hinges,).
      plate: sizes for ``BendingLaw.PLATE``; None without hinges.
      length: of segments [m], shape (num_segments,).
      bend_length: half of both segments' length [m], shape (num_bends,).
    """

    inverse_edges: Array
    area: Array
    angle: Array
    hinge_weight: Array
    plate: PlateRest | None
    length: Array
    bend_length: Array


def rest_shape(topology: Topology, vertices: Any, *, pattern: Any = None, warp: Any = (1.0, 0.0, 0.0)) -> RestShape:
    """The rest shape of a mesh.

    Args:
      topology: the elements, ``scene.topology``.
      vertices: positions at rest [m], shape (num_vertices, 3).
      pattern: flat coordinates of the cloth's vertices [m], shape (num_vertices, 2), warp first; hinges are then flat
        at rest. None: triangles and angles of the vertices.
      warp: without a pattern, the direction whose projection on each triangle is the warp, of any length but 0, shape
        (3,). Where it is normal to a triangle, the triangle's first edge is the warp.

    Gradient: exact with respect to ``vertices`` and ``pattern``.
    """
    x = jnp.asarray(vertices, float)
    flat = x if pattern is None else jnp.pad(jnp.asarray(pattern, float), ((0, 0), (0, 1)))
    triangles, hinges = topology.triangles.indices, topology.hinges.indices
    first, second = (flat[triangles[:, k]] - flat[triangles[:, 0]] for k in (1, 2))
    normal = jnp.cross(first, second)
    twice_area = _length(normal)
    if pattern is None:
        unit = normal / twice_area[:, None]
        warp = jnp.asarray(warp, x.dtype)
        warp = warp / _length(warp)
        along = warp - (unit @ warp)[:, None] * unit
        is_normal = jnp.sum(along**2, axis=-1) < 1e-6
        along = jnp.where(is_normal[:, None], first, along)
        along = along / _length(along)[:, None]
        axes = (along, jnp.cross(unit, along))
        edges = jnp.stack(
            [jnp.stack([jnp.sum(e * a, axis=-1) for e in (first, second)], axis=-1) for a in axes], axis=-2
        )
    else:
        edges = jnp.stack([first[:, :2], second[:, :2]], axis=-1)
    a, b, c, d = edges[:, 0, 0], edges[:, 0, 1], edges[:, 1, 0], edges[:, 1, 1]
    inverse = jnp.stack([jnp.stack([d, -b], axis=-1), jnp.stack([-c, a], axis=-1)], axis=-2)
    inverse = inverse / (a * d - b * c)[:, None, None]
    at = [flat[hinges[:, k]] for k in range(4)]
    edge = at[1] - at[0]
    both = 0.5 * sum(_length(jnp.cross(edge, at[k] - at[0])) for k in (2, 3))
    angle = hinge_angle(tuple(cp.split_vector(p) for p in at)) if pattern is None else jnp.zeros(len(hinges), x.dtype)
    segments, bends = topology.segments.indices, topology.bends.indices
    near = [_length(x[bends[:, k + 1]] - x[bends[:, k]]) for k in (0, 1)]
    return RestShape(
        inverse_edges=inverse,
        area=0.5 * twice_area,
        angle=angle,
        hinge_weight=jnp.sum(edge**2, axis=-1) / both,
        plate=plate_rest(topology, inverse) if len(hinges) else None,
        length=_length(x[segments[:, 1]] - x[segments[:, 0]]),
        bend_length=0.5 * (near[0] + near[1]),
    )


def vertex_mass(topology: Topology, rest: RestShape, cloth: Cloth | None, rope: Rope | None) -> Array:
    """Mass of each vertex [kg], shape (num_vertices,): equal parts of its triangles and segments. Gradient: exact."""
    mass = jnp.zeros(topology.triangles.num_vertices, rest.area.dtype)
    if cloth is not None:
        mass = mass.at[topology.triangles.indices].add((cloth.density * rest.area / 3.0)[:, None])
    if rope is not None:
        mass = mass.at[topology.segments.indices].add((rope.density * rest.length / 2.0)[:, None])
    return mass


def _length(a: Array) -> Array:
    return jnp.sqrt(jnp.sum(a * a, axis=-1))


__all__ = ["RestShape", "rest_shape", "vertex_mass"]
