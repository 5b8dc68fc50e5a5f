"""Bending of cloth as a thin plate: Morley's triangle, with normals at edges interpolated from the angles of hinges.

A hinge's angle theta is the sum of the angles alpha from the edge's normal to the normals of both triangles. Morley's
plate finds the edge's normal by minimizing the energy over all edges. Here alpha is a weighted sum of theta and of the
angles of the four other hinges of both triangles. The weights are those nearest to theta / 2 that are exact for every
constant curvature, on every mesh. So the energy stays local and converges under refinement: it is Morley's energy on a
subspace that contains all constant curvatures.

The curvature of a triangle is sum_e alpha_e L_e / A n_e n_e^T, with lengths L_e, area A and normals n_e of its edges.
At a free edge alpha takes the value at which the edge has no moment.

Sources: Morley 1968, "The triangular equilibrium element in the solution of plate bending problems"; Grinspun et al.
2006, "Computing discrete shape operators on general meshes" for large rotations. The interpolation is rewax's.
"""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.lowering.assembled import assembled
from rewax.lowering.kernels import joined, separated
from rewax.physics.numerics import components as cp
from rewax.physics.thin.stencils import Stencil, Topology
from rewax.physics.thin.unfolded import Hinges, around, hinge_sizes, inverse_2x2
from rewax.types import Array, Scalar

DAMPING, ITERATIONS = 1e-4, 4
"""Damping and iterations of the solution of three equations per hinge, which are singular near a free edge."""


@struct.dataclass
class PlateRest(struct.Replaceable):
    """Sizes of triangles that bend, at rest.

    Attributes:
      weights: of angles of hinges in the angles alpha at the three edges of a triangle [-], shape (15, num_triangles):
        for each edge those of its own hinge, of the triangle's two others from there on, and of two hinges beyond.
      compliance: A S_e : S_f / (L_e L_f) [-] for the edges e f = 00, 11, 22, 12, 20, 01, where the moment S_e has the
        normal component 1 at edge e and 0 at the others, shape (6, num_triangles).
      trace: sqrt(A) tr S_e / L_e [-], shape (3, num_triangles).
    """

    weights: Array
    compliance: Array
    trace: Array


@functools.lru_cache(maxsize=64)
def patch(topology: Topology) -> Stencil:
    """The nine hinges of each triangle: at its edges, then two beyond each edge; 0 where there is none."""
    own, star, sides = around(topology).own, around(topology).star, around(topology).sides
    outer = np.zeros((len(own), 3, 2), int)
    for t, k, beyond in ((0, 1, (3, 4)), (2, 3, (1, 2))):
        outer[sides[:, t], sides[:, k]] = star[:, beyond]
    return Stencil(np.maximum(np.concatenate([own, outer.reshape(-1, 6)], axis=1), 0), len(star))


def plate_rest(topology: Topology, inverse_edges: Array) -> PlateRest:
    """Sizes from the inverse edge matrices of triangles. Gradient: exact."""
    own, sides = around(topology).own, around(topology).sides
    left = _weights(topology, hinge_sizes(topology, inverse_edges))
    right = jnp.eye(5, dtype=left.dtype)[0] - left
    right = right[:, np.array([0, 3, 4, 1, 2])]
    weights = jnp.zeros((len(own), 3, 5), left.dtype)
    weights = weights.at[sides[:, 0], sides[:, 1]].set(left).at[sides[:, 2], sides[:, 3]].set(right)

    edges = inverse_2x2(inverse_edges)
    flat = jnp.stack([jnp.zeros_like(edges[:, :, 0]), edges[:, :, 0], edges[:, :, 1]], axis=1)
    along = jnp.roll(flat, -1, axis=1) - flat
    length = jnp.sqrt(jnp.sum(along**2, axis=-1))
    tangent = along / length[..., None]
    normal = jnp.stack([tangent[..., 1], -tangent[..., 0]], axis=-1)
    area = 0.5 * jnp.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    f, g = jnp.roll(tangent, -1, axis=1), jnp.roll(tangent, -2, axis=1)
    scale = jnp.sum(normal * f, axis=-1) * jnp.sum(normal * g, axis=-1) * length / jnp.sqrt(area)[:, None]
    moment = 0.5 * (f[..., :, None] * g[..., None, :] + g[..., :, None] * f[..., None, :]) / scale[..., None, None]
    free = jnp.asarray(own < 0)
    moment = jnp.where(free[..., None, None], 0.0, moment)
    products = jnp.einsum("tiab,tjab->ijt", moment, moment)
    own_products = jnp.stack([products[k, k] for k in range(3)]) + free.T
    mixed = jnp.stack([products[i, j] for i, j in ((1, 2), (2, 0), (0, 1))])
    return PlateRest(
        weights=weights.reshape(-1, 15).T,
        compliance=jnp.concatenate([own_products, mixed]),
        trace=jnp.trace(moment, axis1=-2, axis2=-1).T,
    )


def _weights(topology: Topology, hinges: Hinges) -> Array:
    """Weights of the five hinges of each star in the angle of the left triangle, shape (num_hinges, 5)."""
    star = around(topology).star
    x0, x1, h1, x2, h2 = hinges
    a, b = _points(-0.5 * x0, 0.0), _points(0.5 * x0, 0.0)
    c, d = _points(x1 - 0.5 * x0, h1), _points(x2 - 0.5 * x0, -h2)
    bend: Any = sum(_side(x0, x - 0.5 * x0, h, sign) for x, h, sign in ((x1, h1, 1.0), (x2, h2, -1.0)))
    rows = [bend]
    for k, edge in enumerate((c - b, a - c, d - a, b - d), start=1):
        u, v = jnp.moveaxis(edge / jnp.sqrt(jnp.sum(edge**2, axis=-1, keepdims=True)), -1, 0)
        turned = ((u * u, 2 * u * v, v * v), (-u * v, u * u - v * v, u * v), (v * v, -2 * u * v, u * u))
        turned = jnp.stack([jnp.stack(row, axis=-1) for row in turned], axis=-2)
        row = jnp.einsum("ei,eij->ej", bend[star[:, k]], turned)
        rows.append(jnp.where(star[:, k, None] < 0, 0.0, row))
    theta = jnp.stack(rows, axis=1) / x0[:, None, None]
    start = 0.5 * jnp.eye(5, dtype=theta.dtype)[0]
    missing = _side(x0, x1 - 0.5 * x0, h1, 1.0) / x0[:, None] - jnp.einsum("j,eji->ei", start, theta)
    gram = jnp.einsum("eji,ejk->eik", theta, theta)
    small = DAMPING * jnp.trace(gram, axis1=-2, axis2=-1)
    damped = cp.split_matrix(gram + small[:, None, None] * jnp.eye(3, dtype=theta.dtype))
    inverse = cp.join_matrix(cp.cofactor(damped)) / cp.det(damped)[:, None, None]
    solution = jnp.zeros_like(missing)
    for _ in range(ITERATIONS):
        rest = missing - jnp.einsum("eik,ek->ei", gram, solution)
        solution += jnp.einsum("eik,ek->ei", inverse, rest)
    return start + jnp.einsum("eji,ei->ej", theta, solution)


def _points(x: Array, y: Any) -> Array:
    return jnp.stack([x, jnp.broadcast_to(y, x.shape)], axis=-1)


def _side(length: Array, along: Array, height: Array, sign: float) -> Array:
    """Angle between a triangle and the tangent plane at its edge's middle, per curvature tt, tn, nn of the edge [m]."""
    return jnp.stack([0.5 * along**2 / height - length**2 / (8.0 * height), sign * along, 0.5 * height], axis=-1)


# --- Moments ----------------------------------------------------------------------------------------------------------


def plate_moment(bending: Scalar, poissons_ratio: Scalar, rest: PlateRest, around: Stencil, angle: Array) -> Array:
    """Derivative of the energy with respect to the angles of hinges [N m], shape (num_hinges,).

    Args:
      bending: flexural rigidity [N m]. poissons_ratio: [-].
      rest: sizes at rest.
      around: the nine hinges of each triangle, see ``patch``.
      angle: of hinges, minus their angle at rest [rad], shape (num_hinges,).
    """
    shared, own = separated((bending, poissons_ratio))
    return _moment(around, shared, (own, rest), angle)


@assembled
def _moment(shared: Any, given: tuple[tuple[Any, PlateRest], tuple[Array, ...]]) -> tuple[Array, ...]:
    (own, rest), angle = given
    bending, ratio = joined(shared, own)
    return _spread(rest.weights, _solve(bending, ratio, rest, _alpha(rest, angle)))


def plate_energy(bending: Scalar, poissons_ratio: Scalar, rest: PlateRest, angle: tuple[Array, ...]) -> Array:
    """Energy of triangles [J]; arguments as for ``plate_moment``."""
    alpha = _alpha(rest, angle)
    moment = _solve(bending, poissons_ratio, rest, alpha)
    total: Any = sum(a * m for a, m in zip(alpha, moment, strict=True))
    return 0.5 * total


def plate_stiffness(
    bending: Scalar, poissons_ratio: Scalar, rest: PlateRest, topology: Topology, slope: Array
) -> Array:
    """An upper bound of the stiffness at the vertices of a flat plate [N/m], shape (num_vertices,): sums of the
    absolute rows of the triangles' stiffness matrices.

    Args:
      bending, poissons_ratio, rest: as for ``plate_moment``.
      topology: the elements.
      slope: d theta/dz of hinges per height of their corners [1/m], shape (num_hinges, 4).
    """
    vertices, slots = _corners_of_patches(topology)
    count, rows = len(vertices), jnp.arange(len(vertices))[:, None]
    each, steep = slope[patch(topology).indices], []
    for k in range(3):
        used = np.array([k, (k + 1) % 3, (k + 2) % 3, 3 + 2 * k, 4 + 2 * k])
        shares = rest.weights[5 * k : 5 * k + 5].T[..., None] * each[:, used]
        at = slots.reshape(count, 9, 4)[:, used].reshape(count, -1)
        steep.append(jnp.zeros(vertices.shape, slope.dtype).at[rows, at].add(shares.reshape(count, -1)))
    one, zero = jnp.ones_like(rest.trace[0]), jnp.zeros_like(rest.trace[0])
    columns = [_solve(bending, poissons_ratio, rest, [one if j == k else zero for j in range(3)]) for k in range(3)]
    moments: list[Any] = [sum(columns[j][k][:, None] * steep[j] for j in range(3)) for k in range(3)]
    matrix: Any = sum(a[:, :, None] * m[:, None, :] for a, m in zip(steep, moments, strict=True))
    bound = jnp.sum(jnp.abs(matrix), axis=-1)
    return jnp.zeros(topology.triangles.num_vertices, slope.dtype).at[vertices].add(bound)


@functools.lru_cache(maxsize=64)
def _corners_of_patches(topology: Topology) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of each triangle's hinges, padded by 0, shape (num_triangles, up to 16), and their numbers in it
    for the four corners of its nine hinges, shape (num_triangles, 36)."""
    found = topology.hinges.indices[patch(topology).indices].reshape(len(topology.triangles), 36)
    first = np.argmax(found[:, :, None] == found[:, None, :], axis=2)
    is_first = first == np.arange(36)
    number = np.cumsum(is_first, axis=1) - 1
    vertices = np.zeros((len(found), 17), np.int32)
    np.put_along_axis(vertices, np.where(is_first, number, 16), found, axis=1)
    return vertices[:, : 1 + number.max()], np.take_along_axis(number, first, axis=1)


def _spread(w: Array, moment: list[Array]) -> tuple[Array, ...]:
    """Transpose of ``_alpha``."""
    inner: list[Any] = [sum(w[5 * k + (j - k) % 3] * moment[k] for k in range(3)) for j in range(3)]
    return (*inner, *(w[5 * k + j] * moment[k] for k in range(3) for j in (3, 4)))


def _alpha(rest: PlateRest, angle: tuple[Array, ...]) -> list[Any]:
    w = rest.weights
    return [
        sum(w[5 * k + j] * angle[(k + j) % 3] for j in range(3))
        + sum(w[5 * k + j] * angle[2 * k + j] for j in (3, 4))
        for k in range(3)
    ]  # fmt: skip


def _solve(bending: Scalar, ratio: Scalar, rest: PlateRest, alpha: list[Array]) -> list[Array]:
    """Moments at edges times length [N m]: K^-1 alpha, with K_ef = A S_e : C^-1 S_f / (L_e L_f)."""
    P, q = rest.compliance, rest.trace
    own = [(1.0 + ratio) * P[k] - ratio * q[k] * q[k] for k in range(3)]
    mixed = [(1.0 + ratio) * P[3 + k] - ratio * q[(k + 1) % 3] * q[(k + 2) % 3] for k in range(3)]
    cofactors = [own[(k + 1) % 3] * own[(k + 2) % 3] - mixed[k] * mixed[k] for k in range(3)]
    crossed = [mixed[(k + 1) % 3] * mixed[(k + 2) % 3] - mixed[k] * own[k] for k in range(3)]
    determinant = own[0] * cofactors[0] + mixed[2] * crossed[2] + mixed[1] * crossed[1]
    scale = bending * (1.0 - ratio * ratio) / determinant
    return [
        scale
        * (
            cofactors[k] * alpha[k]
            + crossed[(k + 2) % 3] * alpha[(k + 1) % 3]
            + crossed[(k + 1) % 3] * alpha[(k + 2) % 3]
        )
        for k in range(3)
    ]


__all__ = ["PlateRest", "patch", "plate_energy", "plate_moment", "plate_rest", "plate_stiffness"]
