"""Self-contact in an implicit step: slope, curvature and blocks of close pairs, which stay those of its beginning.

See ``implicit_contact`` for the time step and ``pair_law`` for the force.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.kernels import pointwise
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import closest, pair_law
from rewax.physics.thin.implicit_contact import Sliding, friction_slope, friction_stiffness
from rewax.physics.thin.newton import Blocks, Linear
from rewax.physics.thin.pair_kernels import to_corners, to_vertices
from rewax.physics.thin.pair_law import ONSET, SMOOTHING, SelfContact
from rewax.physics.thin.self_contact import AllPairs, Pairs
from rewax.types import Array

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene

Four = tuple[Vec3, Vec3, Vec3, Vec3]


class Meeting(NamedTuple):
    """Pairs of one kind at the beginning of a step."""

    pairs: Pairs
    distance: Array
    weights: closest.Weights
    sliding: Sliding
    start: Four
    """Their corners."""


class Kernels(NamedTuple):
    """Functions of one kind of pairs."""

    meet: Callable[[Any, Any], Any]
    slope: Callable[[Any, Any], Any]
    product: Callable[[Any, Any], Any]
    blocks: Callable[[Any, Any], Any]


def meetings(scene: "ThinScene", pairs: AllPairs | None, x: Vec3, v: Vec3) -> list[Meeting | None]:
    """Pairs of both kinds at the beginning of a step. Gradient: exact."""
    if pairs is None:
        return []
    found: list[Meeting | None] = []
    for kernels, kind in zip(_KINDS, pairs, strict=True):
        if kind is None:
            found.append(None)
            continue
        at, moving = gathered(kind, x), gathered(kind, v)
        distance, weights, sliding = kernels.meet(_law(scene), (at, moving, kind.thickness))
        found.append(Meeting(kind, distance, weights, sliding, at))
    return found


def pairs_slope(scene: "ThinScene", met: list[Meeting | None], x: Vec3) -> Vec3:
    """Minus the forces of self-contact on vertices at x at the end of the step [N]. Gradient: exact."""
    total = cp.vector(lambda i: jnp.zeros_like(x[i]))
    for kernels, one in _both(met):
        given = (_known(one), gathered(one.pairs, x))
        total = cp.add(total, summed(one.pairs, kernels.slope(_law_dt(scene), given), x))
    return total


def pairs_curvature(scene: "ThinScene", met: list[Meeting | None], x: Vec3, exact: Array) -> Linear:
    """The product with the derivative of ``pairs_slope``; without the second derivatives of the distance if ``exact``
    is 0. Gradient: none."""
    fixed = [(kernels, one, gathered(one.pairs, x)) for kernels, one in _both(met)]

    def product(p: Vec3) -> Vec3:
        total = cp.vector(lambda i: jnp.zeros_like(p[i]))
        for kernels, one, at in fixed:
            each = kernels.product((*_law_dt(scene), exact), (_known(one), at, gathered(one.pairs, p)))
            total = cp.add(total, summed(one.pairs, each, p))
        return total

    return product


def pairs_blocks(scene: "ThinScene", met: list[Meeting | None], x: Vec3) -> Blocks:
    """The blocks on the diagonal of the positive definite curvature. Gradient: none."""
    zero = cp.vector(lambda i: jnp.zeros_like(x[i]))
    total = Blocks(zero, zero)
    for kernels, one in _both(met):
        each = kernels.blocks(_law_dt(scene), (_known(one), gathered(one.pairs, x)))
        parts = [summed(one.pairs, tuple(b[k] for b in each), x) for k in range(2)]
        total = Blocks(cp.add(total.diagonal, parts[0]), cp.add(total.mixed, parts[1]))
    return total


def gathered(pairs: Pairs, x: Vec3) -> Four:
    """Vectors at the corners of pairs."""
    flat = to_corners(pairs.listed(x[0].shape[-1]), x)
    corner = [(flat[k], flat[4 + k], flat[8 + k]) for k in range(4)]
    return corner[0], corner[1], corner[2], corner[3]


def summed(pairs: Pairs, values: tuple[Vec3, ...], like: Vec3) -> Vec3:
    """Sums at the vertices of vectors at the corners of pairs."""
    flat = tuple(corner[i] for i in cp.AXES for corner in values)
    x, y, z = to_vertices(pairs.listed(like[0].shape[-1]), flat)
    return x, y, z


def _both(met: list[Meeting | None]) -> list[tuple[Kernels, Meeting]]:
    return [(kernels, one) for kernels, one in zip(_KINDS, met, strict=False) if one is not None]


def _known(one: Meeting) -> tuple:
    return one.distance, one.weights, one.sliding, one.start, one.pairs.thickness


def _law(scene: "ThinScene") -> SelfContact:
    assert scene.self_contact is not None
    return pair_law.numbers(scene.self_contact)


def _law_dt(scene: "ThinScene") -> tuple[SelfContact, Array]:
    return _law(scene), jnp.asarray(scene.dt)


# --- Kernels ----------------------------------------------------------------------------------------------------------


def _kernels(with_triangles: bool) -> Kernels:
    def place(x: Four, thickness: Array) -> tuple[closest.Weights, Vec3, Array]:
        """Weights of the closest points, the vector between them, and D^2."""
        if with_triangles:
            weights = closest.vertex_triangle(x)
            between = closest.weighted(weights, x)
            return weights, between, cp.dot(between, between)
        smoothing = SMOOTHING * thickness
        weights = closest.segments(x, smoothing)
        between = closest.weighted(weights, x)
        return weights, between, pair_law.smoothed_square(weights, between, smoothing)

    def rise(x: Four, thickness: Array) -> tuple[Array, Four]:
        """D and its derivative at the corners."""
        weights, between, square = place(x, thickness)
        along = cp.scale(cp.safe_rsqrt(square), between)
        at = [cp.scale(w, along) for w in weights]
        return cp.safe_sqrt(square), (at[0], at[1], at[2], at[3])

    @pointwise
    def meet(law: SelfContact, given: Any) -> tuple[Array, closest.Weights, Sliding]:
        x, v, thickness = given
        weights, between, square = place(x, thickness)
        distance, (_, n) = cp.safe_sqrt(square), cp.unit(between)
        rate = jnp.minimum(cp.dot(n, closest.weighted(weights, v)), 0.0)
        push = _push(law, thickness, distance, rate)
        return distance, weights, Sliding(n, law.friction * push, law.friction_damping * _share(thickness, distance))

    def push_at(law: SelfContact, dt: Array, start: Array, thickness: Array, distance: Array) -> Array:
        return _push(law, thickness, distance, jnp.minimum((distance - start) / dt, 0.0))

    def slid(weights: closest.Weights, start: Four, x: Four) -> Vec3:
        return closest.weighted(weights, tuple(cp.subtract(a, b) for a, b in zip(x, start, strict=True)))

    @pointwise
    def slope(shared: Any, given: Any) -> tuple[Vec3, ...]:
        (law, dt), ((begun, weights, sliding, start, thickness), x) = shared, given
        distance, along = rise(x, thickness)
        push = push_at(law, dt, begun, thickness, distance)
        drag = friction_slope(sliding, slid(weights, start, x), dt)
        return tuple(cp.subtract(cp.scale(w, drag), cp.scale(push, a)) for w, a in zip(weights, along, strict=True))

    @pointwise
    def product(shared: Any, given: Any) -> tuple[Vec3, ...]:
        (law, dt, exact), ((begun, weights, sliding, start, thickness), x, p) = shared, given
        (distance, along), (change, turned) = jax.jvp(lambda x: rise(x, thickness), (x,), (p,))
        push, less = jax.jvp(lambda d: push_at(law, dt, begun, thickness, d), (distance,), (change,))
        u, moved = slid(weights, start, x), closest.weighted(weights, p)
        _, drag = jax.jvp(lambda u: friction_slope(sliding, u, dt), (u,), (moved,))
        kept = exact * push
        return tuple(
            cp.vector(lambda i, w=w, a=a, t=t: w * drag[i] - less * a[i] - kept * t[i])
            for w, a, t in zip(weights, along, turned, strict=True)
        )

    @pointwise
    def blocks(shared: Any, given: Any) -> tuple[Blocks, ...]:
        (law, dt), ((begun, weights, sliding, start, thickness), x) = shared, given
        distance, along = rise(x, thickness)
        one = jnp.ones_like(distance)
        _, less = jax.jvp(lambda d: push_at(law, dt, begun, thickness, d), (distance,), (one,))
        stick, m = friction_stiffness(sliding, slid(weights, start, x), dt), sliding.normal

        def block(w: Array, a: Vec3) -> Blocks:
            def entry(i: int, j: int) -> Array:
                return w * w * stick * (float(i == j) - m[i] * m[j]) - less * a[i] * a[j]

            return Blocks(cp.vector(lambda i: entry(i, i)), cp.vector(lambda i: entry((i + 1) % 3, (i + 2) % 3)))

        return tuple(block(w, a) for w, a in zip(weights, along, strict=True))

    return Kernels(meet, slope, product, blocks)


def _push(law: SelfContact, thickness: Array, distance: Array, rate: Array) -> Array:
    """Normal force [N] at a distance D with its negative rate, see ``pair_law``."""
    depth, onset = thickness - distance, ONSET * thickness
    share = _share(thickness, distance)
    spring = law.stiffness * jnp.where(depth < onset, 0.5 * share * depth, depth - 0.5 * onset)
    return jnp.where(depth > 0, spring - law.damping * share * rate, 0.0)


def _share(thickness: Array, distance: Array) -> Array:
    depth = thickness - distance
    return jnp.where(depth > 0, jnp.clip(depth / (ONSET * thickness), 0.0, 1.0), 0.0)


_KINDS = (_kernels(True), _kernels(False))

__all__ = ["Meeting", "gathered", "meetings", "pairs_blocks", "pairs_curvature", "pairs_slope", "summed"]
