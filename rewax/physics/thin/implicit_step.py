"""Implicit Euler for cloth and ropes: a substep minimizes the incremental potential.

With the displacement x' - x and v' = (x' - x) / dt, the end x' of a substep is a minimum of

    sum m |x' - x - dt v - dt^2 g|^2 / (2 dt^2) + m drag |x' - x|^2 / (2 dt) + elastic and viscous energy + contact,

where held vertices are at their prescribed positions. The parts of the potential are in ``incremental``,
``implicit_contact`` and ``implicit_pairs``, the method in ``newton``. Its derivative is that of the implicit function
theorem: one linear system with the second derivative at x'.

Source: Gast et al. 2015, "Optimization integrator for large time steps".
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.kernels import pointwise
from rewax.lowering.recompute import recomputed
from rewax.physics.contact.penalty import PenaltyContact
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin import implicit_contact as contact
from rewax.physics.thin import incremental, newton
from rewax.physics.thin.bending import bending_stiffness
from rewax.physics.thin.implicit_pairs import Meeting, meetings, pairs_blocks, pairs_curvature, pairs_slope
from rewax.physics.thin.newton import Blocks, Linear
from rewax.physics.thin.self_contact import AllPairs
from rewax.physics.thin.stencils import scatter
from rewax.types import Array

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


class Step(NamedTuple):
    """Vertices at the end of a substep, and the error that Newton's method left."""

    x: Vec3
    v: Vec3
    error: Array
    """[m/s], see ``newton.Minimum``."""


class Known(NamedTuple):
    """Values that are known at the beginning of a substep."""

    x: Vec3
    inertia: Vec3
    """Where vertices would go without forces but gravity."""
    held: Vec3
    """Where held vertices go."""
    before: incremental.Before
    surfaces: list[contact.Surface]
    touches: list[contact.Touch]
    met: list[Meeting | None]


def reach(scene: "ThinScene") -> Array:
    """Bound of the stiffness of bending for the preconditioner [N/m], shape (num_vertices,). Gradient: none."""
    scene = jax.lax.stop_gradient(scene)
    bound = jnp.zeros_like(scene.mass)
    if scene.cloth is not None and len(scene.topology.hinges):
        bound += bending_stiffness(scene) * (1.0 + jnp.max(scene.cloth.damping) / scene.dt)
    return bound


def _solve(
    scene: "ThinScene", bound: Array, at: Step, poses: tuple[Pose, Pose], pins: Array | None, pairs: AllPairs | None
) -> Step:
    settings = scene.stepper
    assert settings is not None
    known = _known(scene, at, poses, pins, pairs)
    moving = jnp.sum(scene.mass if scene.mobility is None else scene.mass * scene.mobility)
    found = newton.minimize(
        lambda x: slope(scene, known, x),
        lambda x, exact: curvature(scene, known, x, exact),
        lambda x: blocks(scene, bound, known, x),
        _held(scene, cp.vector(lambda i: at.x[i] + scene.dt * at.v[i]), known.held),
        mass=jnp.where(moving > 0, moving, 1.0),  # any number if all vertices are held
        tolerance=settings.tolerance,
        iterations=settings.newton_iterations,
        cg_tolerance=settings.cg_tolerance,
        cg_iterations=settings.cg_iterations,
    )
    return _finished(scene, at, found.x, found.error)


def _corrected(
    result: Step,
    scene: "ThinScene",
    bound: Array,
    at: Step,
    poses: tuple[Pose, Pose],
    pins: Array | None,
    pairs: AllPairs | None,
) -> Step:
    """The result, with the derivative of the implicit function theorem."""
    known = _known(scene, at, poses, pins, pairs)
    x = jax.lax.stop_gradient(result.x)
    context = Context(*jax.lax.stop_gradient((scene, bound, known)), x)
    change = _correction(slope(scene, known, x), context)
    return _finished(scene, at, cp.subtract(x, change), jax.lax.stop_gradient(result.error))


class Context(NamedTuple):
    """Inputs of the linear system of a derivative."""

    scene: Any
    bound: Array
    known: Known
    x: Vec3


@jax.custom_jvp
def _correction(residual: Vec3, context: Context) -> Vec3:
    """Returns zero. Its derivative is that of ``solve(curvature, residual)``: the implicit function theorem gives the
    derivative of a converged residual, which is itself zero."""
    del context
    return cp.vector(lambda i: jnp.zeros_like(residual[i]))


@_correction.defjvp
def _correction_jvp(primals: tuple[Vec3, Context], tangents: tuple[Vec3, Context]) -> tuple[Vec3, Vec3]:
    residual, (scene, bound, known, x) = primals
    settings = scene.stepper
    matrix = curvature(scene, known, x, jnp.ones_like(bound[0]))
    factors = newton.factor_blocks(blocks(scene, bound, known, x))

    def solve(matrix: Linear, b: Vec3) -> Vec3:
        found = newton.conjugate_gradients(
            matrix,
            b,
            lambda r: newton.solve_blocks(factors, r),
            tolerance=settings.gradient_tolerance,
            iterations=10 * settings.cg_iterations,
        )
        return cp.vector(lambda i: jnp.where(found.solved, found.x[i], jnp.nan))

    change = jax.lax.custom_linear_solve(matrix, tangents[0], solve, symmetric=True)
    return cp.vector(lambda i: jnp.zeros_like(residual[i])), change


implicit_step = recomputed(_solve, derivative_of=_corrected)
"""One substep: ``implicit_step(scene, bound, at, poses, pins, pairs)`` with ``bound`` of ``reach``. Gradient: exact for
a converged step, forward and reverse; NaN where its linear system is not solved."""


def _finished(scene: "ThinScene", at: Step, x: Vec3, error: Array) -> Step:
    return Step(x, cp.vector(lambda i: (x[i] - at.x[i]) / scene.dt), error)


def _known(scene: "ThinScene", at: Step, poses: tuple[Pose, Pose], pins: Array | None, pairs: AllPairs | None) -> Known:
    x, v, dt = at.x, at.v, scene.dt
    there = contact.surfaces(scene, poses)
    held = cp.vector(lambda i: x[i] + dt * v[i])
    if pins is not None:
        held = scatter(scene.topology.held, (cp.split_vector(pins),))
    return Known(
        x=x,
        inertia=cp.vector(lambda i: x[i] + dt * v[i] + dt * dt * scene.gravity[i]),
        held=held,
        before=incremental.strains_before(scene, x),
        surfaces=there,
        touches=[contact.touch(_law(scene), place, x, v, dt) for place in there],
        met=meetings(scene, pairs, x, v),
    )


# --- The potential ----------------------------------------------------------------------------------------------------


def slope(scene: "ThinScene", known: Known, x: Vec3) -> Vec3:
    """Derivative of the incremental potential with respect to the end of the substep [N]. Gradient: exact."""
    there = _held(scene, x, known.held)
    total = incremental.elastic_slope(scene, known.before, there)
    for place, touch in zip(known.surfaces, known.touches, strict=True):
        total = cp.add(total, contact.touch_slope(_law(scene), place, touch, there, scene.dt))
    if known.met:
        total = cp.add(total, pairs_slope(scene, known.met, there))
    shared = (scene.drag, jnp.asarray(scene.dt))
    return _inertial(shared, (total, x, known.x, known.inertia, known.held, scene.mass, scene.mobility))


@pointwise
def _inertial(shared: Any, given: Any) -> Vec3:
    (drag, dt), (total, x, start, inertia, held, mass, mobility) = shared, given
    free = cp.vector(lambda i: total[i] + mass * ((x[i] - inertia[i]) / (dt * dt) + drag * (x[i] - start[i]) / dt))
    if mobility is None:
        return free
    return cp.vector(lambda i: jnp.where(mobility > 0, free[i], mass * (x[i] - held[i]) / (dt * dt)))


def curvature(scene: "ThinScene", known: Known, x: Vec3, exact: Array) -> Linear:
    """The product with the derivative of ``slope`` if ``exact`` is 1; positive definite if it is 0. Gradient: none."""
    there = _held(scene, x, known.held)
    parts = [incremental.elastic_curvature(scene, known.before, there, exact)]
    for place, touch in zip(known.surfaces, known.touches, strict=True):
        parts.append(contact.touch_curvature(_law(scene), place, touch, there, scene.dt, exact))
    if known.met:
        parts.append(pairs_curvature(scene, known.met, there, exact))
    zero = cp.vector(lambda i: jnp.zeros_like(x[i]))

    def product(p: Vec3) -> Vec3:
        moved = _held(scene, p, zero)
        total = zero
        for part in parts:
            total = cp.add(total, part(moved))
        shared = (scene.drag, jnp.asarray(scene.dt))
        return _inertial(shared, (total, p, zero, zero, zero, scene.mass, scene.mobility))

    return product


def blocks(scene: "ThinScene", bound: Array, known: Known, x: Vec3) -> Blocks:
    """Blocks on the diagonal of the positive definite curvature, for the preconditioner. Gradient: none."""
    there = _held(scene, x, known.held)
    found = [incremental.elastic_blocks(scene, known.before, there)]
    for place, touch in zip(known.surfaces, known.touches, strict=True):
        found.append(contact.touch_blocks(_law(scene), place, touch, there, scene.dt))
    if known.met:
        found.append(pairs_blocks(scene, known.met, there))
    diagonal = mixed = cp.vector(lambda i: jnp.zeros_like(x[i]))
    for one in found:
        diagonal, mixed = cp.add(diagonal, one.diagonal), cp.add(mixed, one.mixed)
    inertia = scene.mass * (1.0 / scene.dt**2 + scene.drag / scene.dt)
    diagonal = cp.vector(lambda i: diagonal[i] + inertia + bound)
    if scene.mobility is None:
        return Blocks(diagonal, mixed)
    moves = scene.mobility > 0
    return Blocks(
        cp.vector(lambda i: jnp.where(moves, diagonal[i], scene.mass / scene.dt**2)),
        cp.vector(lambda i: jnp.where(moves, mixed[i], 0.0)),
    )


def _held(scene: "ThinScene", x: Vec3, held: Vec3) -> Vec3:
    """x with the held vertices elsewhere."""
    if scene.mobility is None:
        return x
    moves = scene.mobility > 0
    return cp.vector(lambda i: jnp.where(moves, x[i], held[i]))


def _law(scene: "ThinScene") -> PenaltyContact:
    """The law of contact of a scene with surfaces."""
    assert scene.contact is not None
    return scene.contact


__all__ = ["Known", "Step", "blocks", "curvature", "implicit_step", "reach", "slope"]
