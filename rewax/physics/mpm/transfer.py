"""Particle-to-grid and grid-to-particle: the hot loop of the material point method.

Both transfers, P2G and G2P, are linear in the transferred fields, and so are their derivatives. Their transposes are
hand-written loops over the particles. With g the cotangent of a node, w its weight, d its offset from the particle and
s = p + A d the momentum that the particle sends to it:

* reverse of particle-to-grid, one gather:  p' = sum w g,  A' = sum w g d^T,  x' = sum grad w (g . s) - A^T sum w g
* reverse of grid-to-particle (v, B), one scatter of s = v' + B' d, and one gather:
  x' = sum grad w (g . s) - B'^T sum w g

Arrays come as separate components (see ``components``). The kernels exist three times: in C++ for CPUs
(``transfer_cpp``), in JAX for CPUs without a compiler (``transfer_xla_cpu``), and in JAX for GPUs (``transfer_gpu``).
Lowering a program for a platform selects them.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call
from rewax.physics.mpm import transfer_cpp, transfer_gpu, transfer_xla_cpu
from rewax.physics.mpm.active_nodes import ActiveNodes
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.transfer_xla_cpu import Layout, as_matrix, as_vector, flat, split
from rewax.physics.numerics.components import Mat3, Vec3
from rewax.types import Array

_SCATTER = ByPlatform(transfer_cpp.scatter, transfer_gpu.scatter)
_GATHER_VALUES = ByPlatform(transfer_cpp.gather_values, transfer_gpu.gather_values)
_SCATTER_TANGENT_TRANSPOSE = ByPlatform(transfer_cpp.scatter_tangent_transpose, transfer_gpu.scatter_tangent_transpose)
_GATHER_TANGENT = ByPlatform(transfer_xla_cpu.gather_tangent, transfer_gpu.gather_tangent)
_GATHER_TANGENT_TRANSPOSE = ByPlatform(transfer_cpp.gather_tangent_transpose, transfer_gpu.gather_tangent_transpose)


class GridFields(NamedTuple):
    """Result of P2G, components of shape (num_nodes,)."""

    mass: Array
    """Node mass [kg]."""
    momentum: Vec3
    """Node momentum [kg m/s]."""


def particle_to_grid(
    grid: Grid, x: Vec3, mass: Array, momentum: Vec3, affine: Mat3, *, active: ActiveNodes | None = None
) -> GridFields:
    """Particle-to-grid transfer (P2G): mass and momentum of particles, summed on the nodes around them.

    Node i receives w_i mass and w_i (momentum + affine d_i), with d_i its offset from the particle. Mass and momentum
    are conserved to rounding, for any affine part.

    Args:
      grid: the nodes.
      x: particle positions [m], components of shape (num_particles,).
      mass: particle masses [kg], shape (num_particles,).
      momentum: particle momenta [kg m/s], components of shape (num_particles,).
      affine: linear field of momentum around each particle [kg/s]; in MLS-MPM -dt vol 4/dx^2 tau + mass C.
      active: the nodes of the result, among them all that particles touch (see ``active_nodes``). None: all, in order.

    Returns:
      Mass and momentum of the nodes, components of shape (num_nodes,).

    Gradient: exact with respect to all arrays, forward and reverse.
    Source: Hu et al. 2018, MLS-MPM, eq. 29; Jiang et al. 2015, APIC.
    """
    layout, locations = _layout(grid, x, active)
    m, px, py, pz = _particle_to_grid(layout, *locations, mass, *momentum, *flat(affine))
    return GridFields(m, (px, py, pz))


def grid_to_particle(grid: Grid, x: Vec3, velocity: Vec3, *, active: ActiveNodes | None = None) -> tuple[Vec3, Mat3]:
    """Grid-to-particle transfer (G2P): node velocities interpolated at particles, with their first moment.

    Args:
      grid: the nodes.
      x: particle positions [m], components of shape (num_particles,).
      velocity: node velocities [m/s], components of shape (num_nodes,).
      active: the nodes of ``velocity``, as in ``particle_to_grid``.

    Returns:
      velocity: sum w_i v_i [m/s], components of shape (num_particles,).
      moment: B = sum w_i v_i d_i^T [m^2/s]; the velocity gradient is C = 4/dx^2 B.

    Gradient: exact with respect to positions and velocities, forward and reverse.
    Source: Jiang et al. 2015, APIC; Hu et al. 2018, MLS-MPM, eq. 17.
    """
    layout, locations = _layout(grid, x, active)
    out = _grid_to_particle(layout, *locations, *velocity)
    return as_vector(out[:3]), as_matrix(out[3:])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _particle_to_grid(layout: Layout, *args: Array) -> Arrays:
    like = [jax.ShapeDtypeStruct((layout.num_nodes,), jnp.result_type(*args))] * 4
    return linear_call(_SCATTER, _GATHER_VALUES, layout, *split(layout, args), like=like)


@_particle_to_grid.defjvp
def _particle_to_grid_jvp(layout: Layout, args: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
    out = _particle_to_grid(layout, *args)
    linear = _without_list(layout, tangents)
    tangent = transfer_xla_cpu.scatter_tangent
    return out, linear_call(tangent, _SCATTER_TANGENT_TRANSPOSE, layout, args, linear, like=out)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _grid_to_particle(layout: Layout, *args: Array) -> Arrays:
    like = [jax.ShapeDtypeStruct(args[0].shape, jnp.result_type(*args))] * 12
    return linear_call(_GATHER_VALUES, _SCATTER, layout, *split(layout, args), like=like)


@_grid_to_particle.defjvp
def _grid_to_particle_jvp(layout: Layout, args: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
    out = _grid_to_particle(layout, *args)
    known, linear = (*args, *out[:3]), _without_list(layout, tangents)
    return out, linear_call(_GATHER_TANGENT, _GATHER_TANGENT_TRANSPOSE, layout, known, linear, like=out)


def _layout(grid: Grid, x: Vec3, active: ActiveNodes | None) -> tuple[Layout, Arrays]:
    if active is None:
        return Layout(grid, None), x
    return Layout(grid, active.index[0].shape[-1]), (*x, active.offset)


def _without_list(layout: Layout, tangents: Arrays) -> Arrays:
    """The tangents without those of column offsets, which are integers."""
    return (*tangents[:3], *split(layout, tangents)[1])
